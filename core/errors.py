"""The two ways a command can fail, and the exit status each maps to."""


class ImagineError(Exception):
    """Base of the errors a user sees as one line, without a traceback."""

    exit_status = 1


class InputError(ImagineError, ValueError):
    """The input was wrong (file, flag, model, device): the message names it and the remedy. Exit status 2."""

    exit_status = 2


class WorkError(ImagineError, RuntimeError):
    """The input was fine but the work failed (lost track, vehicle never armed). Exit status 1."""

    exit_status = 1
