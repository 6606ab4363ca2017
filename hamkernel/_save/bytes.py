"""The bytes of a saved field: a zip of `.npy` arrays that ends in its own checksum.

`numpy.load` opens it: `array_0`, `array_1`, … and `header`, a JSON text as bytes. The comment of
the zip, the last 64 bytes, is the SHA-256 of all bytes before, so that a cut or changed file is
found out before anything is parsed. A digest does not authenticate: whoever rewrites the file can
rewrite its digest, so what is parsed is checked as well.
"""

import hashlib
import io
import json
import math
import os
import pathlib
import uuid
import zipfile

import numpy as np

from hamkernel._save.tree import Node, allowed

FORMAT, VERSION = "hamkernel field", 1

_DIGEST = 64  # hexadecimal digits of SHA-256


def packed(header: Node, arrays: list[np.ndarray]) -> bytes:
    text = json.dumps(header, ensure_ascii=False, allow_nan=False).encode()
    entries = {"header": np.frombuffer(text, np.uint8)}
    entries |= {f"array_{i}": array for i, array in enumerate(arrays)}
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **entries)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = b"0" * _DIGEST  # takes the place of the digest
    content = buffer.getvalue()[:-_DIGEST]
    return content + hashlib.sha256(content).hexdigest().encode()


def write(path: pathlib.Path, content: bytes) -> None:
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


def unpacked(content: bytes, source: str) -> tuple[Node, list[np.ndarray]]:
    if not content.startswith(b"PK\x03\x04"):
        raise ValueError(f"{source} was not written by hamkernel.save.")
    digest = hashlib.sha256(content[:-_DIGEST]).hexdigest().encode()
    if content[-_DIGEST:] != digest:
        raise ValueError(
            f"{source} is cut off, was changed after it was saved, or was not written by "
            "hamkernel.save: its checksum does not fit. Take another copy, or save again."
        )
    try:
        entries = _entries(content)
        header = json.loads(entries.pop("header.npy").tobytes().decode())
    except (zipfile.BadZipFile, ValueError, KeyError, NotImplementedError, RecursionError) as error:
        raise ValueError(f"{source} is not a valid file of hamkernel.save: {error}.") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{source} was not written by hamkernel.save.")
    if header.get("version") != VERSION:
        raise ValueError(
            f"{source} has version {header.get('version')!r} of the format, written by hamkernel "
            f"{header.get('hamkernel')!r}; this library reads version {VERSION}. Update hamkernel."
        )
    names = [f"array_{i}.npy" for i in range(len(entries))]
    if "field" not in header or set(entries) != set(names):
        raise ValueError(f"{source} is not a valid file of hamkernel.save: parts are missing.")
    return header, [entries[name] for name in names]


def _entries(content: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = archive.infolist()
        # Stored as they are, all parts together cannot be larger than the file: no bombs.
        if any(p.compress_type != zipfile.ZIP_STORED or p.flag_bits & 1 for p in parts):
            raise ValueError("a part is compressed or encrypted")
        if len({p.filename for p in parts}) < len(parts):
            raise ValueError("two parts have one name")
        if sum(p.file_size for p in parts) > len(content):
            raise ValueError("its parts are larger than itself")
        return {p.filename: _array(archive.read(p)) for p in parts}


def _array(content: bytes) -> np.ndarray:
    """An array in `.npy` format. NumPy's own reader allocates what the header claims."""
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("an array has an unknown format")
    try:
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    except Exception as error:  # NumPy reads a literal, and lets the errors of its parser through
        raise ValueError("an array has no readable header") from error
    data = content[stream.tell() :]
    if not allowed(dtype.newbyteorder("=")):
        raise ValueError(f"an array has dtype {dtype}, which is not allowed")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError("an array has not the size that it claims")
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
    return array.astype(dtype.newbyteorder("="))
