"""Arithmetic that every CPU rounds alike, for the numbers of a scene whose last bit decides where
an object is placed.

Libraries choose a kernel by the CPU: MKL for square roots, OpenBLAS for products, NumPy for inverse
tangents. Their results differ in the last bit. The functions here use only operations that IEEE 754
rounds correctly: addition, multiplication, division and the square root of double precision. They
give the bits that the official scenes were made with: those of an AMD CPU without AVX-512.
"""

import math
from functools import cache
from importlib.resources import as_file, files

import numpy as np

BIN_BITS = 11
"""An estimate of the reciprocal root is shared by 2^11 neighbouring floats."""
_ONE = 0x3F800000  # bits of the float 1
_SPLIT = 2.0**27 + 1
"""Splits a double into two halves of at most 26 bits each (Veltkamp)."""


@cache
def reciprocal_root_estimates() -> np.ndarray:
    """What the instruction `rsqrtps` of AMD's Zen 3 gives for 1 ≤ x < 4, one value for 2^11 floats
    [8192], float32.
    """
    with as_file(files("mme_vla").joinpath("assets", "arithmetic", "rsqrt_zen3.npy")) as path:
        return np.load(path, allow_pickle=False)


def square_root(x: np.float32) -> np.float32:
    """Square root as MKL computes it on CPUs of other makers than Intel: an estimate, and two steps
    of refinement.

    It differs from the nearest float in 17 % of values. The benchmark turns its cubes by it.

    Args:
        x: positive and finite, float32.

    Returns:
        float32.
    """
    half = np.float32(0.5)
    exponent = (math.frexp(x)[1] - 1) // 2
    scaled = np.float32(math.ldexp(x, -2 * exponent))  # in [1, 4), where the table is
    bin_number = (int(scaled.view(np.uint32)) - _ONE) >> BIN_BITS
    estimate = reciprocal_root_estimates()[bin_number]
    root, half_inverse = scaled * estimate, half * estimate
    error = half - root * half_inverse
    root = root + root * error
    half_inverse = half_inverse + half_inverse * error
    refined = root + (scaled - root * root) * half_inverse
    return np.float32(math.ldexp(refined, exponent))


def fused_multiply_add(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """`a * b + c`, float64, rounded once for all but a few values in 2^50, as the instruction of
    most CPUs does.

    The rounding errors of product and sum are computed exactly (Dekker 1971, Knuth's two-sum) and
    added last.
    """
    product = a * b
    a_high, b_high = _upper_half(a), _upper_half(b)
    a_low, b_low = a - a_high, b - b_high
    product_error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    total = product + c
    c_part = total - product
    total_error = (product - (total - c_part)) + (c - c_part)
    return total + (product_error + total_error)


def _upper_half(a: np.ndarray) -> np.ndarray:
    scaled = _SPLIT * a
    return scaled - (scaled - a)


def matrix_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of [n, k] and [k, m], float64, summed in order by fused multiply-adds, as BLAS does
    on CPUs with them.
    """
    total = a[:, :1] * b[:1]
    for k in range(1, a.shape[1]):
        total = fused_multiply_add(a[:, k : k + 1], b[k : k + 1], total)
    return total


def norm(vector: np.ndarray) -> np.floating:
    """Euclidean length of a vector [n], of its own precision: squares are summed in order, in
    double precision.
    """
    total = 0.0
    for square in vector * vector:
        total = total + float(square)
    return np.sqrt(vector.dtype.type(total))
