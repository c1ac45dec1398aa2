"""Scores against those of the command."""

import json
import struct

import numpy as np
import pytest

import nightsplat
from conftest import to_8_bits

ALEXNET = [("slice1.0", 64, 3, 11), ("slice2.3", 192, 64, 5), ("slice3.6", 384, 192, 3)]
ALEXNET += [("slice4.8", 256, 384, 3), ("slice5.10", 256, 256, 3)]


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    """A safetensors file with AlexNet's tensors, random."""
    draw, tensors = np.random.default_rng(3), {}
    for index, (name, channels, inputs, side) in enumerate(ALEXNET):
        spread = (2 / (inputs * side * side)) ** 0.5
        tensors[f"net.{name}.weight"] = draw.normal(0, spread, (channels, inputs, side, side))
        tensors[f"net.{name}.bias"] = draw.normal(0, 0.1, channels)
        tensors[f"lin{index}.model.1.weight"] = draw.uniform(0, 1, (1, channels, 1, 1))
    header, data = {}, b""
    for name, values in tensors.items():
        data_of = values.astype("<f4").tobytes()
        offsets = [len(data), len(data) + len(data_of)]
        header[name] = {"dtype": "F32", "shape": list(values.shape), "data_offsets": offsets}
        data += data_of
    text = json.dumps(header).encode()
    path = tmp_path_factory.mktemp("lpips") / "alex.safetensors"
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)
    return path


def test_scores_are_those_of_the_command(command, run, room, device, weights):
    scores = command.json("eval", run, "--lpips", weights)
    renderer = nightsplat.Renderer.of_run(run, device)
    lpips = nightsplat.Lpips(weights, device=device)
    found = {"psnr": [], "ssim": [], "lpips": []}
    for view in nightsplat.Dataset.load(room).views:
        reference = view.reference()
        if reference is not None:
            pair = to_8_bits(renderer.render(view.camera).color), to_8_bits(reference)
            found["psnr"].append(nightsplat.psnr(*pair))
            found["ssim"].append(nightsplat.ssim(*pair))
            found["lpips"].append(lpips(*pair))
    assert len(found["psnr"]) == 2
    for name, values in found.items():
        assert np.mean(values) == pytest.approx(scores["mean"][name], rel=1e-6), name


def test_scores_are_of_integers_as_of_floats():
    draw = np.random.default_rng(1)
    one, other = (draw.integers(0, 256, (20, 30, 3)).astype(np.uint8) for _ in range(2))
    expected = -10 * np.log10(np.mean((one / 255 - other / 255) ** 2))
    assert nightsplat.psnr(one, other) == pytest.approx(expected, abs=1e-4)
    assert nightsplat.psnr(one, other / 255) == pytest.approx(expected, abs=1e-4)
    assert nightsplat.psnr(one.astype(np.uint16) * 257, other) == pytest.approx(expected, abs=1e-4)
    assert nightsplat.psnr(one[::-1, ::2].copy(), one[::-1, ::2]) == np.inf
    assert nightsplat.ssim(one, one) == pytest.approx(1)


def test_what_is_no_pair_of_images_is_refused():
    image = np.zeros((4, 5, 3), np.float32)
    with pytest.raises(nightsplat.UsageError, match="the render is 5x4 and the reference 4x4"):
        nightsplat.psnr(image, image[:, 1:])
    for other in (image[..., 0], image.astype(np.int64), np.zeros((0, 5, 3)), image.transpose(2, 0, 1)):
        with pytest.raises(nightsplat.UsageError, match="is no image; pass"):
            nightsplat.ssim(other, other)


def test_weights_that_are_none_are_refused(tmp_path, device):
    with pytest.raises(nightsplat.InputError):
        nightsplat.Lpips(tmp_path / "absent.safetensors", device=device)
