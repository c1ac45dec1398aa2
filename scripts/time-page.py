#!/usr/bin/env python3
"""Times the pages of `export --format html` against each other, in a headless Chromium without a GPU.

    scripts/time-page.py PAGE PAGE... [--rounds 5] [--frames 8] [--size 1280x720]

Each round opens every page in turn, moves the camera in every frame, and takes time and the browser's processor time.
Prints the median frames a second, and processor time a frame, of each page, and the ratios to the first.
"""

import argparse
import importlib.util
import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile

FOLDER = pathlib.Path(__file__).parent

# The camera moves before every frame until as many are drawn; `readPixels` waits for each.
FRAMES = """(async () => {
  const canvas = document.getElementById('canvas'), gl = canvas.getContext('webgl2'), pixel = new Uint8Array(4);
  const draw = gl.drawArraysInstanced.bind(gl), begin = performance.now();
  let drawn = 0;
  gl.drawArraysInstanced = (...all) => { drawn++; draw(...all); };
  for (let move = 0; drawn < FRAMES; move++) {
    const key = move % 8 < 4 ? 'd' : 'a';
    canvas.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true }));
    await new Promise((done) => requestAnimationFrame(done));
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  }
  return [drawn, (performance.now() - begin) / 1000];
})()"""


def test_page():
    """The browser of scripts/test-page.py."""
    spec = importlib.util.spec_from_file_location("test_page", FOLDER / "test-page.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def fit(browser, width, height):
    """Resizes the window so that the canvas has this size; `fit_canvas` needs a page that says when it has settled."""
    window = [width, height + 200]
    for _ in range(20):
        browser.resize(*window)
        now = browser.evaluate("[canvas.width, canvas.height]")
        if now == [width, height]:
            return
        window = [window[0] + width - now[0], window[1] + height - now[1]]
    raise RuntimeError(f"the canvas is {now}, not {[width, height]}")


def processor_seconds(parent):
    """Of a process and all its children."""
    children, spent = {}, {}
    for entry in pathlib.Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
        except (OSError, IndexError):
            continue
        children.setdefault(int(fields[1]), []).append(int(entry.name))
        spent[int(entry.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    total, left = 0.0, [parent]
    while left:
        process = left.pop()
        total += spent.get(process, 0.0)
        left += children.get(process, [])
    return total


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("pages", nargs="+", type=pathlib.Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", default="1280x720")
    arguments = parser.parse_args()
    program = next(filter(None, map(shutil.which, ["chromium", "chromium-browser", "google-chrome"])), None)
    if program is None:
        why = "the pages are not timed: there is no Chromium (on Debian `apt install chromium`)"
        return subprocess.call([FOLDER / "not-run.sh", "chromium", why])
    page = test_page()
    size = [int(number) for number in arguments.size.split("x")]
    rates = {path: [] for path in arguments.pages}
    costs = {path: [] for path in arguments.pages}
    with tempfile.TemporaryDirectory() as profile, page.Browser(program, page.SOFTWARE_GL, profile) as browser:
        for _ in range(arguments.rounds):
            for path in arguments.pages:
                if browser.open(path.resolve().as_uri()) != "true":
                    raise RuntimeError(f"{path} does not open")
                fit(browser, *size)
                before = processor_seconds(browser.process.pid)
                frames, seconds = browser.evaluate(FRAMES.replace("FRAMES", str(arguments.frames)))
                spent = processor_seconds(browser.process.pid) - before
                rates[path].append(frames / seconds)
                costs[path].append(1000 * spent / frames)
    first = arguments.pages[0]
    for path in arguments.pages:
        rate, cost = statistics.median(rates[path]), statistics.median(costs[path])
        print(f"{path}: {rate:.1f} frames a second, {cost:.1f} ms of processor time a frame", end="")
        ratio = statistics.median(own / other for own, other in zip(costs[path], costs[first]))
        print(f" ({ratio:.3f} of {first.name})" if path != first else "")
    return 0


if __name__ == "__main__":
    sys.exit(main())
