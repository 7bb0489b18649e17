"""Arithmetic of scenes: the same bits on every CPU, and close to what libraries compute."""

import hashlib
import math
from fractions import Fraction

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from scipy.spatial.transform import Rotation
from trimesh.creation import box

from mme_vla.envs.robomme.scene.arithmetic import (
    fused_multiply_add,
    matrix_product,
    norm,
    square_root,
)
from mme_vla.envs.robomme.scene.bounding_box import smallest_box
from mme_vla.envs.robomme.scene.objects import quaternion_about_z
from mme_vla.envs.robomme.scene.placement import Draws

RNG = np.random.default_rng(7)
ONES = [np.float32(x) for x in np.linspace(0.001, 16, 4000)]


def digest(values: np.ndarray) -> str:
    return hashlib.sha256(values.tobytes()).hexdigest()[:16]


def test_the_square_root_is_within_two_floats_of_the_exact_one_and_often_not_the_nearest() -> None:
    roots = np.array([square_root(x) for x in ONES])
    nearest = np.sqrt(np.array(ONES, np.float32))
    off_by = np.abs(roots.view(np.int32) - nearest.view(np.int32))
    assert roots.dtype == np.float32 and off_by.max() <= 2
    assert 0.1 < (off_by > 0).mean() < 0.25  # the benchmark's kernel is not the rounded root


def test_the_square_root_has_the_recorded_bits() -> None:
    assert digest(np.array([square_root(x) for x in ONES])) == "5be566e9e04e03a8"


def test_roots_of_powers_of_four_are_exact() -> None:
    assert [square_root(np.float32(4.0**k)) for k in range(-5, 6)] == [2.0**k for k in range(-5, 6)]


def test_a_fused_multiply_add_is_rounded_once() -> None:
    a, b, c = RNG.uniform(-2, 2, (3, 2000))
    c[:1000] = -a[:1000] * b[:1000]  # what is left is the product's rounding error alone
    exact = [
        float(Fraction(x) * Fraction(y) + Fraction(z)) for x, y, z in zip(a, b, c, strict=True)
    ]
    assert fused_multiply_add(a, b, c).tolist() == exact


def test_a_matrix_product_is_summed_in_order_by_fused_multiply_adds() -> None:
    a, b = RNG.uniform(-1, 1, (4, 3)), RNG.uniform(-1, 1, (3, 5))
    expected = np.empty((4, 5))
    for i, j in np.ndindex(4, 5):
        total = a[i, 0] * b[0, j]
        for k in (1, 2):
            total = float(Fraction(a[i, k]) * Fraction(b[k, j]) + Fraction(total))
        expected[i, j] = total
    assert matrix_product(a, b).tolist() == expected.tolist()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_norm_keeps_the_precision_and_is_close(dtype: type) -> None:
    vector = RNG.uniform(-1, 1, 4).astype(dtype)
    assert norm(vector).dtype == dtype
    assert norm(vector) == pytest.approx(np.linalg.norm(vector), rel=4 * float(np.finfo(dtype).eps))


def test_a_number_between_two_is_the_exact_one_rounded_once() -> None:
    numbers, uniforms = Draws(3), Draws(3)
    for low, high in RNG.uniform(-2, 2, (500, 2)):
        low, high = np.float32(low), np.float32(high)
        exact = Fraction(uniforms.uniform()) * Fraction(float(high - low)) + Fraction(float(low))
        assert numbers.between(low, high) == pytest.approx(float(exact), rel=2**-24, abs=2**-149)


@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi / 2, 3.0, math.pi, 4.5, -2.0, 2 * math.pi])
def test_a_quaternion_about_the_vertical_turns_by_its_angle(yaw: float) -> None:
    w, x, y, z = quaternion_about_z(yaw)
    assert w >= 0 and x == y == 0
    turned = Rotation.from_quat([x, y, z, w]).as_matrix()
    assert turned == pytest.approx(Rotation.from_euler("z", yaw).as_matrix(), abs=2e-6)


def test_quaternions_have_the_recorded_bits() -> None:
    angles = np.linspace(-7, 7, 2000)
    assert (
        digest(np.stack([quaternion_about_z(float(yaw)) for yaw in angles])) == "791bfbcf9d33c6d4"
    )


def test_the_smallest_box_of_a_turned_box_has_its_widths_in_order_and_its_axes() -> None:
    widths = np.array([0.3, 0.1, 0.2])
    rotation = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()
    mesh = box(widths)
    mesh.apply_transform(
        np.block([[rotation, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
    )
    axes, measured = smallest_box(mesh)
    assert measured == pytest.approx(sorted(widths), abs=1e-12)
    assert np.abs(axes @ rotation) == pytest.approx(np.eye(3)[[1, 2, 0]], abs=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.3])
def test_the_smallest_box_is_as_large_as_trimeshs(yaw: float) -> None:
    mesh = box((0.04, 0.04, 0.04))
    mesh.apply_transform(
        np.block([[Rotation.from_euler("z", yaw).as_matrix(), np.ones((3, 1))], [np.eye(4)[3:]]])
    )
    _, widths = smallest_box(mesh)
    assert widths.prod() == pytest.approx(
        mesh.bounding_box_oriented.primitive.extents.prod(), rel=1e-9
    )
