"""Forms that are none."""

from __future__ import annotations

import logging

import pytest

from service.api.body import parse_multipart
from service.errors import InputError


def test_broken_forms_leave_no_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO), pytest.raises(InputError, match="not a multipart form"):
        parse_multipart(b"--b\r\nno header\r\n\r\n", "multipart/form-data; boundary=b", 4)
    assert caplog.records == []
