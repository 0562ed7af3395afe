"""Hashes that are the same in every process.

`hashlib` has BLAKE2 (RFC 7693) too, but loads OpenSSL for others, which takes 0.6 MB of each process with a link.
"""

try:
    from _blake2 import blake2b
except ImportError:  # A Python that has it elsewhere.
    from hashlib import blake2b


def hash_bytes(data: bytes, size: int) -> bytes:
    """The BLAKE2b hash of some bytes; `size` is its own, from 1 to 64 bytes."""
    return blake2b(data, digest_size=size).digest()
