"""The file of a saved field: a first line with a version and a SHA-256, and the content.

A cut or changed file is found out before anything is parsed. A digest does not authenticate:
whoever rewrites a file can rewrite its digest too, so what is parsed is checked as well.
"""

import hashlib
import os
import pathlib
import re
import uuid

_VERSION = 2  # of the format; 1 was an archive of NumPy's, before the first release
_FIRST_LINE = "hamkernel field, version {}, sha256 {}"


def sealed(content: bytes) -> bytes:
    """The file with this content."""
    digest = hashlib.sha256(content).hexdigest()
    return _FIRST_LINE.format(_VERSION, digest).encode() + b"\n" + content


def opened(content: bytes, source: str) -> bytes:
    """The content of a file of `save`.

    Raises:
        ValueError: the file is another one, or was cut or changed, or is of another version.
    """
    first, _, rest = content.partition(b"\n")
    known = re.fullmatch(_FIRST_LINE.format("([0-9]+)", "([0-9a-f]{64})").encode(), first)
    if known is None:
        old = " It may be of a version before 0.1.0: fit again." * content.startswith(b"PK")
        raise ValueError(f"{source} was not written by hamkernel.save, or is cut off.{old}")
    if int(known[1]) != _VERSION:
        raise ValueError(
            f"{source} has version {int(known[1])} of the format and this library reads version "
            f"{_VERSION}: load it with the hamkernel that wrote it."
        )
    if hashlib.sha256(rest).hexdigest().encode() != known[2]:
        raise ValueError(
            f"{source} is cut off or was changed after hamkernel.save wrote it: its checksum does "
            "not fit. Take another copy, or save again."
        )
    return rest


def write(path: pathlib.Path, content: bytes) -> None:
    """Write all of the file or nothing: a new one takes the place of the old one at once."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; save needs the name of a file.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {path.parent} to write {path.name} to.")
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # else a crash could leave the new name on an empty file
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
