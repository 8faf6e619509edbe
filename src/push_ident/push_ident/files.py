"""Writing of files: whole or not at all, through no link, and never under a name that somebody else can guess; and JSON for every reader.

Every file that this project writes goes through this module, except for bags, whose chunks must be on the disk at once
(`open_new`). A file is written under a random name in the same folder, brought to the disk and then renamed, so that a kill, a full disk
or a second writer leaves the old file or the new one. Renaming replaces a link instead of following it.
"""

from __future__ import annotations

import errno
import json
import math
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Final

from push_ident.errors import PushIdentError
from push_ident.limits import LIMITS, plain_text

_NO_LINK: Final = os.O_NOFOLLOW | os.O_CLOEXEC


def write_whole(
    path: Path,
    content: str | bytes,
    what: str,
    *,
    private: bool = False,
    durable: bool = True,
    error: type[PushIdentError] = PushIdentError,
) -> None:
    """Replace a file as a whole.

    Args:
        path: File to write; its folder is made.
        content: All of it; text is written as UTF-8.
        what: Names the content in an error.
        private: Only the user may read it (0600, new folders 0700); otherwise the umask decides.
        durable: The content is on the disk when the function returns; otherwise it survives a kill, not a power cut.
        error: Raised where the file cannot be written.
    """
    with replaced(path, what, private=private, durable=durable, error=error) as file:
        file.write(content.encode("utf-8", "replace") if isinstance(content, str) else content)


@contextmanager
def replaced(
    path: Path, what: str, *, private: bool = False, durable: bool = True, error: type[PushIdentError] = PushIdentError
) -> Iterator[IO[bytes]]:
    """A file to write into that replaces `path` when the context ends without an exception; arguments as of `write_whole`."""
    path = Path(path)
    if not path.name or path.name == ".." or "\0" in str(path):
        raise error(f"Cannot write {what}: the path {plain_text(str(path))!r} names no file; give a folder and a name.")
    part = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        make_folder(path.parent, private=private)
        with open_new(part, private=private) as file:
            try:
                yield file
                file.flush()
                if durable:
                    os.fsync(file.fileno())
                os.replace(part, path)
            except BaseException:
                with suppress(OSError):
                    part.unlink()
                raise
        if durable:
            _sync_folder(path.parent)
    except (OSError, UnicodeEncodeError) as failure:
        raise error(f"Cannot write {what} to {plain_text(str(path))}: {_why(failure)}.") from None


def open_new(path: Path, *, private: bool = False) -> IO[bytes]:
    """Create a file that grows while it is written, such as a bag. Raises OSError where anything of that name exists, a link too."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK
    return os.fdopen(os.open(path, flags, 0o600 if private else 0o666), "wb")  # less what the umask of the user takes away


def open_log(path: Path) -> IO[str]:
    """Append to a file of text, or create it. Raises OSError where the name is a link."""
    number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | _NO_LINK, 0o666)
    return os.fdopen(number, "a", encoding="utf-8", errors="replace")


def make_folder(path: Path, *, private: bool = False) -> None:
    """Make a folder and those above it. `private`: those that are new are for the user only (0700). Raises OSError."""
    if not private:
        path.mkdir(parents=True, exist_ok=True)
        return
    for folder in reversed([path, *path.parents]):
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
    if not path.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))


def read_regular(path: Path, most: int = LIMITS.TEXT_FILE.value) -> bytes:
    """Content of a regular file of at most `most` bytes.

    Raises OSError: no file has such a name, it cannot be read, is a pipe, a device or a folder, or is larger. Such a file could block, or
    never end.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a name with a null byte, or one that cannot be encoded
        raise OSError(errno.EINVAL, f"no file has such a name ({error})", str(path)) from None
    with os.fdopen(number, "rb") as file:
        if not stat.S_ISREG(os.fstat(number).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"larger than {most} bytes", str(path))
    return content


def json_text(content: dict[str, Any]) -> str:
    """JSON text; numbers that are not finite become null."""
    return json.dumps(finite(content), indent=1) + "\n"


def finite(value: Any) -> Any:
    """The value with None instead of numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def _sync_folder(path: Path) -> None:
    """Bring the new name to the disk; some file systems cannot."""
    with suppress(OSError):
        number = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def _why(failure: OSError | UnicodeEncodeError) -> str:
    if isinstance(failure, UnicodeEncodeError):
        return "the name cannot be encoded; choose another"
    remedy = "free some space" if failure.errno in (errno.ENOSPC, errno.EDQUOT) else "choose a folder with write permission"
    return f"{failure.strerror or failure}; {remedy}"
