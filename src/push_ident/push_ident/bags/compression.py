"""Compressed content of bags: how much of it a file may have, and zstd with a bounded output."""

from __future__ import annotations

from pathlib import Path

from push_ident.errors import BagError
from push_ident.limits import LIMITS

try:
    from compression import zstd  # type: ignore[import-not-found]
except ImportError:
    from backports import zstd


def check_expansion(total: int, file_size: int, what: str) -> None:
    """Raise BagError for more uncompressed content than an honest file of this size can have [bytes]: a decompression bomb."""
    if total > LIMITS.UNCOMPRESSED.value + LIMITS.EXPANSION.value * file_size:
        raise BagError(
            f"{what}: {LIMITS.EXPANSION.meaning} over {total / 1e9:.2g} GB in a file of {file_size / 1e6:.3g} MB, "
            f"expected at most {LIMITS.EXPANSION.value} {LIMITS.EXPANSION.unit}. Record without compression, or split the bag."
        )


def zstd_claim(begin: bytes) -> int:
    """Uncompressed size that data in zstd claim to have [bytes], from their begin; 0 where they do not say."""
    return int(zstd.get_frame_info(begin).decompressed_size or 0)


def uncompressed_message(data: bytes) -> bytes:
    """A message that was compressed with zstd. Raises BagError for one that is cut or too large."""
    decompressor = zstd.ZstdDecompressor()
    message: bytes = decompressor.decompress(data, max_length=LIMITS.MESSAGE.value + 1)
    LIMITS.MESSAGE.check(len(message), "a compressed message", error=BagError)
    if not decompressor.eof:
        raise BagError("a compressed message is cut short; the file is damaged.")
    return message


def uncompress_file(path: Path, target: Path) -> None:
    """Uncompress a file in zstd. Raises BagError for one that is cut, or is a decompression bomb."""
    size, total, most = path.stat().st_size, 0, 1 << 20
    with path.open("rb") as file, target.open("xb") as out:
        decompressor = zstd.ZstdDecompressor()
        while not decompressor.eof:
            block = file.read(most) if decompressor.needs_input else b""
            if decompressor.needs_input and not block:
                raise BagError(f"{path.name} is cut short.")
            data = decompressor.decompress(block, max_length=most)
            total += len(data)
            check_expansion(total, size, path.name)
            out.write(data)
