"""CRC-32C of large buffers with NumPy, as TFRecord files use it.

The register of a CRC is linear over GF(2) in the message: it can be cut into lanes whose remainders matrices join, as zlib's
`crc32_combine` does. Lane k holds the words k, k + LANES, k + 2 LANES, ..., so that one step takes a contiguous row.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint32]

# Castagnoli's polynomial with its bits reversed (RFC 3720, section 12.1).
POLYNOMIAL = 0x82F63B78
# TFRecord rotates a CRC and adds this, so that the CRC of data which hold CRCs is not degenerate (TensorFlow, crc32c.h).
MASK_DELTA = 0xA282EAD8

# The fastest of 2048 to 32768 lanes for records of some MB, where the joining of the lanes counts.
LOG2_LANES = 12
LANES = 1 << LOG2_LANES
# Shorter messages are taken byte by byte.
MIN_LANED_BYTES = 1024


def masked_crc32c(data: bytes) -> int:
    """Compute the masked CRC-32C that TFRecord files hold."""
    crc = crc32c(data)
    return ((crc >> 15 | crc << 17) + MASK_DELTA) & 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """Compute the CRC-32C (Castagnoli) of a message."""
    words = len(data) // 4 if len(data) >= MIN_LANED_BYTES else 0
    register = _laned(np.frombuffer(data, "<u4", words)) if words else 0xFFFFFFFF
    table = _byte_table()
    for byte in data[4 * words :]:
        register = int(table[(register ^ byte) & 0xFF]) ^ (register >> 8)
    return register ^ 0xFFFFFFFF


def _laned(words: Words) -> int:
    """Return the register after words (n,), from the first register on."""
    head = len(words) % LANES or min(len(words), LANES)
    # Zeros before the message leave an empty register empty; the first register is added to the first word.
    state = np.zeros(LANES, dtype=np.uint32)
    state[LANES - head :] = words[:head]
    state[LANES - head] ^= np.uint32(0xFFFFFFFF)
    low_table, high_table = _row_tables()
    low, high = np.empty(LANES, np.intp), np.empty(LANES, np.intp)
    from_low, from_high = np.empty_like(state), np.empty_like(state)
    for row in words[head:].reshape(-1, LANES):
        np.bitwise_and(state, np.uint32(0xFFFF), out=low)
        np.right_shift(state, np.uint32(16), out=high)
        # With "raise", the default, NumPy would buffer the output; all indices have 16 bits.
        low_table.take(low, out=from_low, mode="wrap")
        high_table.take(high, out=from_high, mode="wrap")
        np.bitwise_xor(from_low, from_high, out=state)
        state ^= row
    for level in reversed(range(LOG2_LANES)):
        half = 1 << level
        state = _product(_after_words(level), state[:half]) ^ state[half:]
    return int(_product(_after_words(0), state)[0])


@cache
def _byte_table() -> Words:
    """Register (256,) after one zero byte, by its lowest byte."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(POLYNOMIAL), table >> 1)
    return table


@cache
def _after_words(log2_words: int) -> Words:
    """Matrix over GF(2) that takes a register past 2^k zero words: column b (32,) is the image of bit b."""
    if log2_words:
        half = _after_words(log2_words - 1)
        return _product(half, half)
    columns = np.uint32(1) << np.arange(32, dtype=np.uint32)
    for _ in range(4):
        columns = _byte_table()[columns & 0xFF] ^ (columns >> 8)
    return columns


@cache
def _row_tables() -> tuple[Words, Words]:
    """Return the registers (65536,) after a row of zeros, of the lower and of the upper 16 bits."""
    bits = np.arange(1 << 16, dtype=np.uint32)
    return _product(_after_words(LOG2_LANES), bits), _product(_after_words(LOG2_LANES), bits << np.uint32(16))


def _product(matrix: Words, registers: Words) -> Words:
    """Multiply a matrix (32,) and registers (n,) over GF(2)."""
    out = np.zeros_like(registers)
    for bit in range(32):
        # -1 times the bit has all bits set where it is set.
        out ^= matrix[bit] * ((registers >> np.uint32(bit)) & np.uint32(1))
    return out
