"""SAM2Act+'s geometry against golden numbers of the original code, and what follows
from its rules.
"""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.sam2act_golden import load, meta, relative_error
from mme_vla.extras.methods.sam2act import geometry
from mme_vla.extras.methods.sam2act.geometry import Cube, shift_and_rotate, unproject

TOLERANCE = 1e-5


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    return load("geometry")


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array)


def test_a_depth_image_becomes_world_points(golden: dict[str, np.ndarray]) -> None:
    inputs = [
        golden[f"unproject/{name}"] for name in ("depth", "intrinsic", "extrinsic_world_to_camera")
    ]
    assert relative_error(unproject(*inputs), golden["unproject/points"]) < TOLERANCE
    # The benchmark writes extrinsics without their last row.
    assert np.array_equal(unproject(inputs[0], inputs[1], inputs[2][:3]), unproject(*inputs))


def test_points_outside_the_bounds_are_dropped(golden: dict[str, np.ndarray]) -> None:
    cube = Cube.of(golden["bound/bounds"])
    for number, (points, features) in enumerate(
        zip(golden["bound/points"], golden["bound/features"], strict=True)
    ):
        inside = cube.inside(tensor(points)).numpy()
        assert np.array_equal(points[inside], golden[f"bound/kept{number}"])
        assert np.array_equal(features[inside], golden[f"bound/kept_features{number}"])


def test_points_stand_where_the_virtual_cameras_see_them(golden: dict[str, np.ndarray]) -> None:
    points = tensor(golden["project/points"])
    side = meta()["sizes"]["res"]
    assert relative_error(geometry.project(points, side), golden["project/pixels"]) < TOLERANCE
    assert relative_error(geometry.project(points, 224), golden["project/pixels_224"]) < TOLERANCE


def test_targets_are_cut_gaussians_that_sum_to_one(golden: dict[str, np.ndarray]) -> None:
    pixels, side = tensor(golden["target/pixels"]), golden["target/sigma1.5"].shape[-1]
    assert relative_error(geometry.targets(pixels, side), golden["target/sigma1.5"]) < TOLERANCE
    sharp = geometry.targets(pixels, side, sigma=-1)
    assert relative_error(sharp.flatten(1), golden["target/sigma-1"]) < TOLERANCE


def test_maps_are_read_between_pixels(golden: dict[str, np.ndarray]) -> None:
    values = geometry.read_maps(tensor(golden["pick/maps"]), tensor(golden["pick/pixels"]))
    assert relative_error(values, golden["pick/values"]) < TOLERANCE


def test_three_heatmaps_agree_on_a_point(golden: dict[str, np.ndarray]) -> None:
    logits = tensor(golden["waypoint/logits"])
    finder = geometry.PointFinder(logits.shape[-1])
    assert relative_error(finder.find(logits), golden["waypoint/points"]) < TOLERANCE
    maps = logits[0, :, 0].flatten(1).softmax(-1).view_as(logits[0, :, 0])
    assert (
        relative_error(finder.scores(maps).flatten(), golden["waypoint/scores_first"]) < TOLERANCE
    )
    cells = torch.cartesian_prod(finder.line, finder.line, finder.line)
    assert relative_error(cells[:10], golden["waypoint/grid_first_ten"]) < TOLERANCE
    assert relative_error(cells[-1], golden["waypoint/grid_last"]) < TOLERANCE


def test_the_loss_of_heatmaps(golden: dict[str, np.ndarray]) -> None:
    logits, target = tensor(golden["waypoint/logits"])[:, :, 0], tensor(golden["heat_loss/target"])
    losses = geometry.soft_cross_entropy(logits, target.transpose(1, 2).view_as(logits))
    assert relative_error(losses, golden["heat_loss/per_sample_view"]) < TOLERANCE
    assert relative_error(losses.mean(), golden["heat_loss/mean"]) < TOLERANCE


def test_rotations_are_the_bins_of_the_original(golden: dict[str, np.ndarray]) -> None:
    count = 72
    bins = geometry.to_bins(tensor(golden["rotation/quaternions_xyzw"]), count)
    assert np.array_equal(bins.numpy(), golden["rotation/bins"])
    angles = geometry.angles_of_bins(bins, count).numpy()
    back = torch.from_numpy(Rotation.from_euler("xyz", angles, degrees=True).as_quat())
    assert relative_error(back, golden["rotation/back_xyzw"]) < TOLERANCE


def test_the_renderer_follows_its_rules_to_the_pixel() -> None:
    golden = load("render")
    points, features, side = (
        tensor(golden["points"]),
        tensor(golden["features"]),
        int(golden["resolution"]),
    )
    nearest = geometry.z_buffer(points, features, side)
    splats = geometry.splat(*nearest, float(golden["radius"]))
    for kind, (image, depth) in {"plain": nearest, "splat": splats}.items():
        assert relative_error(image, golden[f"{kind}_image"]) < TOLERANCE
        assert relative_error(depth, golden[f"{kind}_depth"]) < TOLERANCE
    assert (
        relative_error(
            geometry.render(points, features, side, float(golden["radius"])), golden["output"]
        )
        < TOLERANCE
    )


def test_what_is_behind_a_camera_stands_before_everything() -> None:
    # the second is above the eye of the view from the top
    points = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 1.5]])
    images, depth = geometry.z_buffer(points, torch.tensor([[1.0], [2.0]]), 4)
    assert images[0, 2, 2].item() == 2.0
    assert depth[0, 2, 2].item() == 0.0


def test_points_that_are_no_numbers_or_out_of_view_leave_no_trace() -> None:
    points = torch.tensor([[float("nan"), 0.0, 0.0], [3.0, 3.0, 3.0]])
    images, depth = geometry.z_buffer(points, torch.ones(2, 1), 8)
    assert not images.any()
    assert (depth == geometry.EMPTY).all()


def test_virtual_images_have_ten_channels_of_known_meaning() -> None:
    points = torch.rand(50, 3) - 0.5
    channels = geometry.virtual_images(points, torch.rand(50, 3), 14)
    assert channels.shape == (geometry.VIEWS, 10, 14, 14)
    assert channels[:, 7].flatten(1).unique(dim=1).flatten().tolist() == [-1, 0, 1]
    assert torch.equal(channels[0, 8, :, 3], torch.linspace(-1, 1, 14))
    assert torch.equal(channels[2, 9, 5], torch.linspace(-1, 1, 14))
    filled = channels[:, :3].abs().sum(1) > 0
    assert torch.allclose(channels[:, 6][filled].mean(), torch.tensor(0.0), atol=1e-5)


def test_turning_about_a_point_leaves_it_and_heights_alone() -> None:
    points, centre = torch.rand(2, 5, 3), torch.rand(2, 3)
    points[:, 0] = centre
    quarter, nothing = torch.full((2,), torch.pi / 2), torch.zeros(2, 3)
    turned = shift_and_rotate(points, centre, nothing, quarter)
    assert torch.allclose(turned[:, 0], centre)
    assert torch.allclose(turned[..., 2], points[..., 2])
    across, turned_across = points - centre[:, None], turned - centre[:, None]
    assert torch.allclose(turned_across[..., 0], -across[..., 1], atol=1e-6)
    shift = torch.tensor([[0.1, 0.2, 0.3]]).expand(2, 3)
    assert torch.allclose(
        shift_and_rotate(points, centre, shift, quarter * 0), points + shift[:, None], atol=1e-6
    )
