"""Durable training jobs, independent of HTTP. They need file locks of POSIX: Linux, macOS or WSL."""

try:
    import fcntl  # noqa: F401
except ImportError as error:
    raise ImportError(
        "the packages jobs and service need the module fcntl for file locks, which Windows does not have; run them on "
        "Linux, macOS or WSL"
    ) from error
