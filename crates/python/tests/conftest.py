"""The device, the command and a small run that tests share.

`NIGHTSPLAT` is the command; `NIGHTSPLAT_DEVICE` selects another device than the default. Every test runs under the
validation layer with synchronization validation: a message fails the test that caused it, and with
NIGHTSPLAT_FAIL_ON_VALIDATION the process at its exit, as in the tests of Rust.
"""

import json
import os
import pathlib
import subprocess

import numpy as np
import pytest

import nightsplat

os.environ["NIGHTSPLAT_FAIL_ON_VALIDATION"] = "1"

STEPS = 40


class Command:
    """The command `nightsplat`."""

    def __init__(self, program: str) -> None:
        self.program = program

    def __call__(self, *arguments: object, fails: bool = False) -> str:
        done = subprocess.run([self.program, *map(str, arguments)], capture_output=True, text=True)
        assert (done.returncode != 0) == fails, done.stderr
        return done.stderr if fails else done.stdout

    def json(self, *arguments: object) -> dict:
        return json.loads(self(*arguments, "--json"))


def to_8_bits(image):
    """As images are saved, and scored."""
    return np.round(np.clip(image, 0, 1) * 255) / 255


@pytest.fixture(scope="session")
def command() -> Command:
    program = os.environ.get("NIGHTSPLAT")
    assert program, "NIGHTSPLAT names the command; scripts/test-python.sh sets it"
    return Command(program)


@pytest.fixture(scope="session")
def device() -> nightsplat.Device:
    return nightsplat.Device(os.environ.get("NIGHTSPLAT_DEVICE", ""), validation=True)


@pytest.fixture(autouse=True)
def no_validation_message(caplog):
    yield
    messages = [record.getMessage() for record in caplog.get_records("call") if record.name == "vulkan"]
    assert not messages


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> pathlib.Path:
    """A dataset of 16 photographs."""
    folder = tmp_path_factory.mktemp("python") / "room"
    nightsplat.synthetic_dataset(folder, size=(64, 48), views=16)
    return folder


@pytest.fixture(scope="session")
def run(command, room) -> pathlib.Path:
    """A run of the command."""
    out = room.parent / "run"
    command("train", room, "--out", out, "--steps", STEPS, "--device", os.environ.get("NIGHTSPLAT_DEVICE", ""))
    return out


@pytest.fixture
def arrays():
    """The arrays of some hundred Gaussians around (0, 0, 4)."""
    draw, count = np.random.default_rng(7), 300
    return {
        "means": draw.uniform(-1, 1, (count, 3)).astype(np.float32) + np.float32([0, 0, 4]),
        "quats": draw.normal(size=(count, 4)).astype(np.float32),
        "log_scales": draw.uniform(-3, -2, (count, 3)).astype(np.float32),
        "raw_opacities": draw.uniform(-1, 2, count).astype(np.float32),
        "dc": draw.uniform(-0.5, 1.5, (count, 3)).astype(np.float32),
        "rest": draw.uniform(-0.2, 0.2, (count, 8, 3)).astype(np.float32),
    }
