"""Results come in order, few are waiting, and what goes wrong is not lost."""

from __future__ import annotations

import threading

import pytest

from models_export.data.ahead import mapped_ahead


def test_results_come_in_order() -> None:
    assert list(mapped_ahead(lambda n: n * n, range(50), 4)) == [n * n for n in range(50)]
    assert list(mapped_ahead(str, [])) == []


def test_no_more_is_begun_than_can_wait() -> None:
    begun = []
    lock = threading.Lock()

    def work(n: int) -> int:
        with lock:
            begun.append(n)
        return n

    results = mapped_ahead(work, range(100), 3)
    for taken in range(10):
        assert next(results) == taken
        with lock:
            assert max(begun) <= taken + 3


def test_an_error_reaches_who_takes_the_result() -> None:
    def work(n: int) -> int:
        if n == 2:
            raise ValueError("two")
        return n

    results = mapped_ahead(work, range(5), 2)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(results)
