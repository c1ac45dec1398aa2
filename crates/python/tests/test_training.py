"""Trainings against those of the command; interruption, other threads, and errors."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import nightsplat
from conftest import STEPS


def equal(one, other):
    for name, values in one.arrays().items():
        np.testing.assert_array_equal(values, other.arrays()[name], err_msg=name)


def test_a_training_has_the_bits_of_the_command(run, room, device, tmp_path):
    training = nightsplat.train(room, steps=STEPS, device=device)
    assert training.plan is not None and training.settings["steps"] == STEPS and training.ended is None
    half = tmp_path / "half.checkpoint"
    steps = []
    for step in training:
        steps.append(step.step)
        if step.step == STEPS // 2:
            training.save_checkpoint(half)
        assert np.isfinite(step.loss) and step.gaussians > 0 and step.milliseconds > 0
    assert steps == list(range(1, STEPS + 1))
    assert training.ended is not None and list(training) == []
    of_command = nightsplat.Model.load(run / "model.ply")
    # Files hold what was trained.
    training.model().save(tmp_path / "model.ply")
    equal(nightsplat.Model.load(tmp_path / "model.ply"), of_command)
    resumed = nightsplat.train(room, steps=STEPS, device=device, resume=half)
    rest = [step.step for step in resumed]
    assert rest == list(range(STEPS - len(rest) + 1, STEPS + 1))
    equal(resumed.model(), training.model())


def test_without_a_plan_settings_are_those_of_the_preset(room, device):
    tone = {"curve": "ap3", "alpha": 0.1}
    training = nightsplat.train(room, preset="paper", steps=1, device=device, tone=tone)
    assert training.plan is None
    assert training.settings["tone"]["curve"] == "ap3" and training.settings["tone"]["alpha"] == 0.1
    assert nightsplat.train(room, plan=False, steps=1, device=device).plan is None


def test_other_threads_run_while_it_trains(room, device):
    training = nightsplat.train(room, plan=False, steps=STEPS, device=device)
    counts, done = [0], threading.Event()

    def count():
        while not done.is_set():
            counts[0] += 1
            time.sleep(0.001)

    counter = threading.Thread(target=count)
    counter.start()
    next(training)
    during = counts[0]
    done.set()
    counter.join()
    assert during > 5


INTERRUPTED = """
import pathlib, signal, sys
import nightsplat

# Whatever a parent in the background has left it at.
signal.signal(signal.SIGINT, signal.default_int_handler)
room, out = map(pathlib.Path, sys.argv[1:])
training = nightsplat.train(room, plan=False, steps=100000, device=nightsplat.Device(validation=True))
done = 0
try:
    for step in training:
        done = step.step
        if done == 1:
            print("begun", flush=True)
except KeyboardInterrupt:
    # Nothing is lost: the training goes on, and its model is whole.
    assert next(training).step in (done + 1, done + 2)
    training.model().save(out / "model.ply")
    print("interrupted", flush=True)
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of another process")
def test_ctrl_c_ends_a_training_within_a_second_and_leaves_it_whole(room, tmp_path):
    program = [sys.executable, "-c", INTERRUPTED, room, tmp_path]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "begun\n"
        time.sleep(0.2)
        assert list(tmp_path.iterdir()) == []
        asked = time.monotonic()
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "interrupted\n"
        waited = time.monotonic() - asked
        assert process.wait() == 0
    assert len(nightsplat.Model.load(tmp_path / "model.ply")) > 0
    # Half a second of steps; a loaded machine takes longer.
    assert waited < 10


@pytest.mark.parametrize(
    ("settings", "options", "kind"),
    [
        ({"steps": -1}, ["--set", "steps=-1"], nightsplat.SettingError),
        ({"tone": {"theta": "much"}}, ["--set", "tone.theta=much"], nightsplat.SettingError),
        ({"tone": {"curve": "none-such"}}, ["--set", "tone.curve=none-such"], nightsplat.UsageError),
        ({"stepps": 3}, ["--set", "stepps=3"], nightsplat.UsageError),
        ({"preset": "hasty"}, None, nightsplat.UsageError),
    ],
)
def test_a_wrong_setting_has_the_text_of_the_command(command, room, device, tmp_path, settings, options, kind):
    with pytest.raises(kind) as raised:
        nightsplat.train(room, device=device, **settings)
    assert isinstance(raised.value, nightsplat.Error)
    if options is not None:
        printed = command("train", room, "--out", tmp_path / "run", *options, fails=True)
        # The command names its options as well.
        assert str(raised.value) in re.sub(r" \(--[a-z]+\)", "", printed)


def test_other_errors_have_their_classes_and_the_texts_of_the_command(command, tmp_path, device):
    absent = tmp_path / "absent"
    with pytest.raises(nightsplat.InputError) as raised:
        nightsplat.train(absent, device=device)
    assert str(raised.value) in command("train", absent, "--out", tmp_path / "run", fails=True)
    with pytest.raises(nightsplat.InputError) as raised:
        nightsplat.Model.load(absent)
    assert str(absent) in str(raised.value)
    with pytest.raises(nightsplat.DeviceError, match="nonesuch"):
        nightsplat.Device("nonesuch")
    with pytest.raises(nightsplat.UsageError, match="steps is .*; pass a bool, a number"):
        nightsplat.train(absent, device=device, steps=object())


def test_warnings_go_to_logging(room, device, caplog, tmp_path):
    copy = tmp_path / "room"
    shutil.copytree(room, copy)
    photographs = sorted((copy / "low").iterdir())
    photographs[1].write_bytes(b"cut short")
    nightsplat.Dataset.load(copy)
    warnings = [record for record in caplog.records if record.name.startswith("nightsplat")]
    assert any("skipped" in record.getMessage() for record in warnings)
