"""Tone curves, diagnosis and files against those of the command."""

import numpy as np
import pytest

import nightsplat
from conftest import to_8_bits


@pytest.mark.parametrize(
    ("options", "settings"),
    [
        ([], {}),
        (["--curve", "ap3", "--theta", "0.4"], {"curve": "ap3", "theta": 0.4}),
        (["--brightness", "0.5", "--colour", "0.5"], {"brightness": 0.5, "colour": 0.5}),
    ],
)
def test_a_photograph_is_tone_mapped_as_by_the_command(command, room, device, tmp_path, options, settings):
    path = sorted((room / "low").iterdir())[0]
    command("tone", "apply", path, "--out", tmp_path, *options)
    mapped = nightsplat.tone_map(nightsplat.load_image(path), device=device, **settings)
    assert mapped.mean() > 2 * nightsplat.load_image(path).mean()
    np.testing.assert_array_equal(to_8_bits(mapped), to_8_bits(nightsplat.load_image(tmp_path / path.name)))


def test_a_photograph_without_light_or_number_is_refused(device):
    with pytest.raises(nightsplat.UsageError, match="almost black"):
        nightsplat.tone_map(np.zeros((16, 16, 3), np.uint8), device=device)
    with pytest.raises(nightsplat.UsageError, match="NaN or infinity"):
        nightsplat.tone_map(np.full((16, 16, 3), np.nan), device=device)


def test_a_diagnosis_is_that_of_the_command(command, room, device):
    found = nightsplat.diagnose(room, device=device, preset="fast", downscale=2)
    assert found == command.json("diagnose", room, "--preset", "fast", "--downscale", "2")
    assert found["device"] == device.name and len(found["views"]) == 14


def test_an_image_is_saved_as_it_is_read(tmp_path):
    image = np.random.default_rng(2).integers(0, 256, (10, 12, 3)).astype(np.uint8)
    nightsplat.save_image(tmp_path / "image.png", image)
    np.testing.assert_allclose(nightsplat.load_image(tmp_path / "image.png"), image / 255, atol=1e-6)
    nightsplat.save_image(tmp_path / "image.exr", image)
    np.testing.assert_allclose(nightsplat.load_image(tmp_path / "image.exr"), image / 255, atol=1e-3)


def test_views_have_what_their_files_hold(room):
    views = nightsplat.Dataset.load(room, downscale=2).views
    assert sum(view.is_train for view in views) == 14 and len(views) == 16
    for view in views:
        assert view.camera.size == (32, 24)
        assert (view.reference() is None) == view.is_train
        photograph = view.photograph()
        if view.is_train:
            assert photograph.shape == (24, 32, 3) and photograph.mean() < 0.2
