"""A message of the validation layer fails the test that caused it."""

import pathlib
import shutil
import subprocess
import sys

MESSAGE = """
import logging

def test_with_a_message():
    logging.getLogger("vulkan").error("VUID-of-a-mistake")
"""


def test_a_message_fails_its_test(tmp_path):
    shutil.copy(pathlib.Path(__file__).with_name("conftest.py"), tmp_path)
    (tmp_path / "test_with_a_message.py").write_text(MESSAGE)
    program = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path]
    done = subprocess.run(program, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 1 and "VUID-of-a-mistake" in done.stdout, done.stdout
