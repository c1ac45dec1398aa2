#!/usr/bin/env python3
"""Opens the page of `export --format html` in a headless Chromium and compares its canvas with `render`.

    scripts/test-page.py [NIGHTSPLAT]      (default: target/release/nightsplat, or debug)

Trains a small synthetic set, opens the page from disk at the size of its views and at twice that, and requires 30 dB or
more for every view. Turns the background grey by its key and black again by its control: grey must show where the
model is empty, and not where it is opaque. Then opens the page in a browser without WebGL, which it must report. Needs
Python and Chromium, which it controls by the DevTools protocol through a pipe; without Chromium it prints `not run`.
"""

import base64
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time

ENOUGH = 30.0  # dB
SIZES = [(96, 72), (192, 144)]
PATIENCE = 120  # seconds

SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
NO_GL = ["--disable-gpu", "--disable-3d-apis"]

COMPARE = """(async (png) => {
  const canvas = document.getElementById('canvas'), image = new Image();
  image.src = png;
  await image.decode();
  if (image.width !== canvas.width || image.height !== canvas.height) throw new Error('sizes differ');
  const copy = Object.assign(document.createElement('canvas'), { width: image.width, height: image.height });
  const context = copy.getContext('2d', { willReadFrequently: true });
  const pixels = (source) => {
    context.drawImage(source, 0, 0);
    return context.getImageData(0, 0, image.width, image.height).data.filter((_, k) => k % 4 !== 3);
  };
  const [a, b] = [pixels(image), pixels(canvas)];
  const square = a.reduce((sum, value, k) => sum + (value - b[k]) ** 2, 0) / a.length;
  return 10 * Math.log10(255 ** 2 / Math.max(square, 1e-9));
})('PNG')"""

# Key G from far away: before, after, and once the control has been clicked. The red of every pixel; alpha is ignored.
GREY = """(async () => {
  const canvas = document.getElementById('canvas'), gl = canvas.getContext('webgl2');
  const press = (key) => canvas.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true }));
  const red = async () => {
    await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
    const pixels = new Uint8Array(4 * canvas.width * canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return [...pixels.filter((_, k) => k % 4 === 0)];
  };
  for (let step = 0; step < 100; step++) press('s');
  const before = await red();
  press('g');
  const grey = await red(), isShown = document.getElementById('grey').checked;
  document.getElementById('grey').click();
  const after = await red(), added = grey.map((value, k) => value - before[k]);
  return {
    isShown, empty: grey[0], least: Math.min(...added), most: Math.max(...added),
    opaque: added.filter((value) => value <= 4).length,
    changed: after.filter((value, k) => value !== before[k]).length,
  };
})()"""


class Browser:
    """Chromium with one page."""

    def __init__(self, program, options, profile):
        # Chromium reads commands from descriptor 3 and writes answers to 4.
        theirs_in, self.to = os.pipe()
        self.answers, theirs_out = os.pipe()
        command = [program, "--headless=new", "--no-sandbox", "--remote-debugging-pipe", f"--user-data-dir={profile}"]
        command += ["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
        shell = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}'
        self.process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *command, *options],
            pass_fds=[theirs_in, theirs_out],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self.received = b""
        self.last = 0
        self.session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()

    def call(self, method, **parameters):
        self.last += 1
        message = {"id": self.last, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.received:
                more = os.read(self.answers, 1 << 16)
                if not more:
                    raise RuntimeError("the browser ended")
                self.received += more
            answer, self.received = self.received.split(b"\0", 1)
            answer = json.loads(answer)
            if answer.get("id") == self.last:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]

    def evaluate(self, script):
        result = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            raise RuntimeError(result["exceptionDetails"]["exception"]["description"])
        return result["result"].get("value")

    def resize(self, width, height):
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        # A scroll bar for controls that do not fit would narrow the canvas.
        self.call("Emulation.setScrollbarsHidden", hidden=True)
        # Two frames: one in which the page sees its size, one in which it has drawn.
        self.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))")

    def open(self, page, view=0):
        """Opens the page and returns its state: `true` or `failed`."""
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=f"{page.as_uri()}#view={view}")
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            ready = self.evaluate("document.documentElement?.dataset.ready")
            if ready:
                return ready
            time.sleep(0.1)
        raise RuntimeError(f"{page} did not open in {PATIENCE} s")

    def fit_canvas(self, width, height):
        """Resizes the window so that the canvas has this size."""
        window = [max(width, 400), height + 200]
        # Controls larger than the window initially leave no space.
        for _ in range(20):
            self.resize(*window)
            now = self.evaluate("[canvas.width, canvas.height]")
            if now == [width, height]:
                return
            window = [window[0] + width - now[0], window[1] + height - now[1]]
        raise RuntimeError(f"the canvas is {now}, not {[width, height]}")


def nightsplat_of_this_tree():
    target = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", pathlib.Path(__file__).parent.parent / "target"))
    found = [target / profile / "nightsplat" for profile in ("release", "debug")]
    return next((str(path) for path in found if path.exists()), "nightsplat")


def main():
    nightsplat = sys.argv[1] if len(sys.argv) > 1 else nightsplat_of_this_tree()
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        why = "the page in a browser: there is none (on Debian `apt install chromium`)"
        return subprocess.call([pathlib.Path(__file__).parent / "not-run.sh", "chromium", why])
    failed = 0
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        folder = pathlib.Path(folder)

        def run(*arguments):
            subprocess.run([nightsplat, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)

        for width, height in SIZES:
            run("synth", folder / f"set-{width}", "--views", 16, "--width", width, "--height", height)
        trained = folder / f"set-{SIZES[0][0]}"
        run("train", trained, "--out", folder / "run", "--steps", 200, "--progress", "none")
        run("export", folder / "run", "--format", "html")
        page = folder / "run/model.html"
        with Browser(program, SOFTWARE_GL, folder / "profile") as browser:
            for width, height in SIZES:
                renders = folder / f"renders-{width}"
                run("render", folder / "run", "--split", "test", "--out", renders, "--dataset", folder / f"set-{width}")
                pictures = sorted(renders.rglob("*.png"))
                for view, picture in enumerate(pictures):
                    if browser.open(page, view) != "true":
                        raise RuntimeError(browser.evaluate("document.getElementById('message').textContent"))
                    browser.fit_canvas(width, height)
                    png = "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode()
                    psnr = browser.evaluate(COMPARE.replace('PNG', png))
                    print(f"{'ok' if psnr >= ENOUGH else 'BAD':3} {psnr:5.1f} dB  {picture.stem} at {width}x{height}")
                    failed += psnr < ENOUGH
                if not pictures:
                    raise RuntimeError(f"no renders in {renders}")
            seen = browser.evaluate(GREY)
            # Half floats round by one level.
            is_grey = seen["isShown"] and seen["empty"] in (127, 128) and seen["least"] >= -1 and seen["most"] <= 129
            is_grey = is_grey and seen["opaque"] > 0 and seen["changed"] == 0
            print(f"{'ok' if is_grey else 'BAD':3} before grey: {seen}")
            failed += not is_grey
        with Browser(program, NO_GL, folder / "profile-without") as browser:
            ready = browser.open(page)
            message = browser.evaluate("document.getElementById('message').textContent")
            is_said = ready == "failed" and "no WebGL 2" in message
            print(f"{'ok' if is_said else 'BAD':3} without WebGL: {message}")
            failed += not is_said
    print(f"{'failed: ' + str(failed) if failed else 'every view of the page is the render'}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
