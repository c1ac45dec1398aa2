"""Models as arrays and files, and their renders against those of the command."""

import numpy as np
import pytest

import nightsplat
from conftest import to_8_bits
from nightsplat import Camera, Model, Renderer


def forward(size=(64, 48)):
    return Camera.perspective(np.eye(4), 1.0, size)


def equal(one, other):
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_arrays_make_the_model_that_they_came_from(arrays, tmp_path):
    model = Model.from_arrays(**arrays, origin=(1, 2, 3))
    assert (len(model), model.sh_degree, model.origin) == (300, 2, (1, 2, 3))
    equal(model.arrays(), arrays)
    model.save(tmp_path / "model.ply")
    loaded = Model.load(str(tmp_path / "model.ply"))
    equal(loaded.arrays(), arrays)
    assert loaded.origin == (1, 2, 3)


@pytest.mark.parametrize("extension", ["spz", "sog", "glb"])
def test_other_formats_are_written(arrays, tmp_path, extension):
    path = tmp_path / f"model.{extension}"
    Model.from_arrays(**arrays).save(path)
    assert path.stat().st_size > 1000
    if extension != "glb":
        assert len(Model.load(path)) == 300


def test_arrays_of_other_shapes_are_refused(arrays):
    short = {**arrays, "quats": arrays["quats"][1:]}
    with pytest.raises(nightsplat.UsageError, match=r"quats has the shape \(299, 4\); it must be \(300, 4\)"):
        Model.from_arrays(**short)
    with pytest.raises(nightsplat.UsageError, match="rest has 7 coefficients; it must have 0, 3, 8 or 15"):
        Model.from_arrays(**{**arrays, "rest": arrays["rest"][:, 1:]})
    with pytest.raises(nightsplat.UsageError, match="hold NaN or infinity"):
        Model.from_arrays(**{**arrays, "dc": arrays["dc"] * np.nan})


def test_a_file_is_whole_or_absent(arrays, tmp_path):
    with pytest.raises(nightsplat.UsageError, match="has no extension of a model file"):
        Model.from_arrays(**arrays).save(tmp_path / "model.obj")
    with pytest.raises(nightsplat.OutputError):
        Model.from_arrays(**arrays).save(tmp_path / "absent" / "model.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_splat_has_its_depth_colour_and_alpha(device):
    dc = (np.float32([[0.2, 0.5, 0.8]]) - 0.5) / 0.28209479177387814
    model = Model.from_arrays([[0, 0, 3]], [[1, 0, 0, 0]], [[-1, -1, -1]], [2.0], dc)
    render = Renderer(model, device).render(forward())
    assert (render.color.shape, render.depth.shape, render.alpha.shape) == ((48, 64, 3), (48, 64), (48, 64))
    assert {render.color.dtype, render.depth.dtype, render.alpha.dtype} == {np.dtype(np.float32)}
    opacity = 1 / (1 + np.exp(-2.0))
    assert render.alpha[24, 32] == pytest.approx(opacity, abs=0.01)
    np.testing.assert_allclose(render.color[24, 32], opacity * np.array([0.2, 0.5, 0.8]), atol=0.01)
    assert render.depth[24, 32] == pytest.approx(3, abs=1e-4)
    assert render.alpha[0, 0] == 0 and np.isinf(render.depth[0, 0])


def test_parallel_rays_show_a_splat_as_large_from_farther_away(device):
    model = Model.from_arrays([[0, 0, 3]], [[1, 0, 0, 0]], [[-1, -1, -1]], [2.0], np.float32([[0.2, 0.5, 0.8]]))
    renderer, away = Renderer(model, device), np.eye(4)
    away[2, 3] = 4.0
    near, far = (renderer.render(Camera.orthographic(pose, 2.0, (64, 48))) for pose in (np.eye(4), away))
    assert near.alpha[24, 32] > 0.8
    np.testing.assert_allclose(far.alpha, near.alpha, atol=1e-5)
    assert far.depth[24, 32] - near.depth[24, 32] == pytest.approx(4, abs=1e-4)


def test_positions_far_from_the_origin_keep_their_precision(arrays, device):
    here = Renderer(Model.from_arrays(**arrays), device).render(forward())
    far = np.array([5e5, 4e6, 300.0])
    pose = np.eye(4)
    pose[:3, 3] = -far
    there = Renderer(Model.from_arrays(**arrays, origin=tuple(far)), device)
    np.testing.assert_array_equal(there.render(Camera.perspective(pose, 1.0, (64, 48))).color, here.color)


def test_a_batch_is_its_cameras(arrays, device):
    renderer = Renderer(Model.from_arrays(**arrays), device)
    aside = np.eye(4)
    aside[0, 3] = 0.3
    cameras = [forward(), Camera.perspective(aside, 1.0, (64, 48))]
    batch = renderer.render(cameras)
    assert batch.color.shape == (2, 48, 64, 3) and batch.depth.shape == (2, 48, 64)
    for index, camera in enumerate(cameras):
        one = renderer.render(camera)
        for name in ("color", "depth", "alpha"):
            np.testing.assert_array_equal(getattr(batch, name)[index], getattr(one, name))
    with pytest.raises(nightsplat.UsageError, match=r"\[64, 48\] and \[32, 24\] pixels; render them one by one"):
        renderer.render([forward(), forward((32, 24))])
    with pytest.raises(nightsplat.UsageError, match="a batch has no camera"):
        renderer.render([])


def test_renders_are_lent_to_others_without_a_copy(arrays, device):
    color = Renderer(Model.from_arrays(**arrays), device).render(forward()).color
    lent = np.from_dlpack(color)
    assert lent.ctypes.data == color.ctypes.data
    view = memoryview(color)
    assert (view.format, view.shape, view.c_contiguous) == ("f", (48, 64, 3), True)


def test_renders_are_those_of_the_command(command, run, room, device, tmp_path):
    command("render", run, "--split", "test", "--out", tmp_path)
    renderer, shown = Renderer.of_run(run, device), 0
    for view in nightsplat.Dataset.load(room).views:
        if not view.is_train:
            picture = nightsplat.load_image(tmp_path / f"{view.name}.png")
            np.testing.assert_array_equal(to_8_bits(renderer.render(view.camera).color), to_8_bits(picture))
            shown += 1
    assert shown == 2


def test_a_layer_has_its_name(run, room, device):
    camera = nightsplat.Dataset.load(room).views[0].camera
    renderer = Renderer.of_run(run, device)
    normal = renderer.layer(camera, "normal")
    lengths = np.linalg.norm(normal, axis=2)
    assert normal.shape == (48, 64, 3) and np.all((lengths < 1e-6) | (abs(lengths - 1) < 1e-3))
    np.testing.assert_array_equal(renderer.layer(camera, "alpha")[..., 0], renderer.render(camera).alpha)
    with pytest.raises(nightsplat.UsageError, match="unknown layer `smell`; the layers are rgb"):
        renderer.layer(camera, "smell")


def test_the_best_device_is_opened_where_none_is_named(arrays):
    assert nightsplat.Device.names()
    one, other = (Renderer(Model.from_arrays(**arrays)) for _ in range(2))
    np.testing.assert_array_equal(one.render(forward()).color, other.render(forward()).color)
