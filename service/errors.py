"""Every error that Quadlift raises on purpose, and the HTTP status that each one carries.

    QuadliftError (500)
    |-- InputError (422)            a value that the caller can mend
    |   |-- FrameError (422)        not an image, truncated, wrong size
    |   |-- TooLargeError (413)     more bytes, pixels or parts than the limits allow
    |   |-- SlowSenderError (408)   a body that does not come in time
    |   |-- CalibrationError (422)  camera, ground plane or site that cannot be used
    |   |-- NotFoundError (404)     unknown site, camera or frame
    |   |-- UnauthorizedError (401) no token, or an unknown one
    |   `-- ForbiddenError (403)    a token without the scope, a page of a foreign origin
    |-- OverloadError (503)         busy or starting; Retry-After says when to come back
    |-- RunTimeoutError (504)       the networks hung on a frame set
    |-- StorageError (507)          the data folder cannot be written
    `-- PackError (500)             a pack that is missing, damaged or not what its manifest says

The way of a request is bytes -> header check -> decode -> networks -> boxes; the first three raise only InputError kinds.
"""

from __future__ import annotations


class QuadliftError(Exception):
    """Base of all errors. ``message`` says what is wrong, ``field`` where, ``remedy`` what to do about it."""

    status = 500
    code = "internal"

    def __init__(self, message: str, *, field: str | None = None, remedy: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.field = field
        self.remedy = remedy

    def __str__(self) -> str:
        parts = [f"{self.field}: {self.message}" if self.field else self.message]
        if self.remedy:
            parts.append(self.remedy)
        return " ".join(parts)


class InputError(QuadliftError):
    """A value given by the caller cannot be used."""

    status = 422
    code = "invalid_input"


class FrameError(InputError):
    """A frame is not an image, is truncated, or has another size than its camera's."""

    code = "invalid_frame"


class TooLargeError(InputError):
    """A request holds more bytes, pixels or parts than the limits allow."""

    status = 413
    code = "too_large"


class SlowSenderError(InputError):
    """A request's body did not come in time."""

    status = 408
    code = "too_slow"


class CalibrationError(InputError):
    """A camera, a ground plane or a whole site cannot be used for geometry."""

    code = "invalid_calibration"


class NotFoundError(InputError):
    """A site, a camera or a frame that nobody registered."""

    status = 404
    code = "not_found"


class UnauthorizedError(InputError):
    """The service wants a token, and none that it knows was sent."""

    status = 401
    code = "unauthorized"


class ForbiddenError(InputError):
    """The sender is known, or names its origin, and may not do this."""

    status = 403
    code = "forbidden"


class OverloadError(QuadliftError):
    """The service is starting or has more work than it can do in time.

    ``retry_after_s`` (seconds) becomes the Retry-After header.
    """

    status = 503
    code = "overloaded"

    def __init__(self, message: str, *, retry_after_s: int = 1, remedy: str | None = None) -> None:
        super().__init__(message, remedy=remedy)
        self.retry_after_s = retry_after_s


class RunTimeoutError(QuadliftError):
    """The networks took so long on a frame set that it was given up."""

    status = 504
    code = "run_timeout"

    def __init__(self, took_s: float) -> None:
        super().__init__(
            f"the networks had not finished this frame set after {took_s:.1f} s, and it was given up.",
            remedy="Send the next one; if it happens often, see the service's log and QUADLIFT_RUN_LIMIT_MS.",
        )


class StorageError(QuadliftError):
    """A change could not be kept on disk, so it was not made."""

    status = 507
    code = "storage"


class PackError(QuadliftError):
    """A pack's file is missing, altered, or not what its manifest says."""

    code = "invalid_pack"
