#!/usr/bin/env python3
"""Opens the pages of `export --format html` and `view` in a headless Chromium and compares their canvas with `render`.

    scripts/test-page.py [NIGHTSPLAT]      (default: target/release/nightsplat, or debug)

Trains a small synthetic set, opens the page from disk at the size of its views and at twice that, and requires 30 dB
or more for every view. Turns the background grey by its key and black again by its control: grey must show where the
model is empty, and not where it is opaque. Shows the other layers, and the difference to a photograph; touches move
the camera. The page of a set lit by a lamp at the camera, with the lamp on, must be the render that has it. Opens the
page of a training under way: a new model must be shown within two seconds of its checkpoint, and
the page pauses, continues and stops the training. Edits the model in the page: `edit` with the saved list, rendered,
must be the page's picture, and so must a keyframe, rendered by `render --path`. No console message may appear. Then
opens the page in a browser without WebGL, which it must report. Needs Python and Chromium, which it controls by the
DevTools protocol through a pipe; without Chromium it prints `not run`.
"""

import base64
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
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
  const send = (kind, key) =>
    canvas.dispatchEvent(new KeyboardEvent(kind, { key, shiftKey: key === 's', bubbles: true }));
  const red = async () => {
    await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
    while (document.documentElement.dataset.settled !== 'true') await new Promise((done) => setTimeout(done, 20));
    const pixels = new Uint8Array(4 * canvas.width * canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return [...pixels.filter((_, k) => k % 4 === 0)];
  };
  send('keydown', 's');
  await new Promise((done) => setTimeout(done, 3000));
  send('keyup', 's');
  const before = await red();
  send('keydown', 'g');
  const grey = await red(), isShown = document.getElementById('grey').checked;
  document.getElementById('grey').click();
  const after = await red(), added = grey.map((value, k) => value - before[k]);
  return {
    isShown, empty: grey[0], least: Math.min(...added), most: Math.max(...added),
    opaque: added.filter((value) => value <= 4).length,
    changed: after.filter((value, k) => value !== before[k]).length,
  };
})()"""

# What the button of the live page downloads.
SAVED = """(async () => {
  const own = window.download;
  const saved = new Promise((done) => { window.download = (name, blob) => done({ name, blob }); });
  document.getElementById('exportModel').click();
  const { name, blob } = await saved;
  window.download = own;
  return { name, bytes: (await asUri(blob)).replace(/^.*,/, '') };
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
        # What the page or the browser complains of.
        self.complaints = []
        self.session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log"):
            self.call(f"{domain}.enable")

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
            if answer.get("method") in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
                self.complaints.append(json.dumps(answer["params"])[:500])
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

    def settle(self):
        """Waits until all of the model is drawn in its order."""
        self.wait("document.documentElement.dataset.settled === 'true'")

    def wait(self, condition):
        """Waits for a condition of the page, and returns the seconds."""
        begin = time.monotonic()
        while not self.evaluate(condition):
            if time.monotonic() > begin + PATIENCE:
                raise RuntimeError(f"never: {condition}; {self.complaints}")
            time.sleep(0.05)
        return time.monotonic() - begin

    def open(self, url, view=0, face=""):
        """Opens the page and returns its state: `true` or `failed`."""
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=f"{url}#view={view}&{face}")
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            ready = self.evaluate("document.documentElement?.dataset.ready")
            if ready:
                return ready
            time.sleep(0.1)
        raise RuntimeError(f"{url} did not open in {PATIENCE} s; {self.complaints}")

    def fit_canvas(self, width, height):
        """Resizes the window so that the canvas has this size."""
        window = [max(width, 400), height + 200]
        # Controls larger than the window initially leave no space.
        for _ in range(20):
            self.resize(*window)
            now = self.evaluate("[canvas.width, canvas.height]")
            if now == [width, height]:
                self.settle()
                return
            window = [window[0] + width - now[0], window[1] + height - now[1]]
        raise RuntimeError(f"the canvas is {now}, not {[width, height]}")


class Serving:
    """A command that serves a page."""

    def __init__(self, nightsplat, *arguments):
        command = [nightsplat, *map(str, arguments)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for line in self.process.stderr:
            if "http://" in line:
                self.url = next(word for word in line.split() if word.startswith("http://"))
                # What it writes later must not block it.
                threading.Thread(target=self.process.stderr.read, daemon=True).start()
                return
        raise RuntimeError(f"{command} serves nothing")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


# The page that the live page offers for download.
EXPORTED = """(async () => {
  let blob = null;
  const make = URL.createObjectURL;
  URL.createObjectURL = (own) => { blob = own; return make.call(URL, own); };
  document.getElementById('exportPage').click();
  while (!blob) await new Promise((done) => setTimeout(done, 50));
  URL.createObjectURL = make;
  return blob.text();
})()"""

# Red, green and blue of the whole canvas.
MEAN = """(() => {
  const canvas = document.getElementById('canvas'), gl = canvas.getContext('webgl2');
  const pixels = new Uint8Array(4 * canvas.width * canvas.height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const mean = (k) => pixels.reduce((sum, value, at) => sum + (at % 4 === k ? value : 0), 0) / pixels.length * 4;
  return [0, 1, 2].map(mean);
})()"""


# Left, top, width and height of the canvas.
BOX = "(() => { const b = canvas.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"


def select(browser, control, value, event="change"):
    browser.evaluate(f"""(() => {{
      const control = document.getElementById('{control}');
      if (control.type === 'checkbox') control.checked = {json.dumps(value)}; else control.value = {json.dumps(value)};
      control.dispatchEvent(new Event('{event}', {{ bubbles: true }}));
    }})()""")
    browser.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))")
    browser.settle()


def layers(browser):
    """Every layer is another picture, pixels count their Gaussians, and the difference to a photograph is shown."""
    seen = []
    for layer in range(4):
        select(browser, "layer", str(layer))
        seen.append(browser.evaluate(MEAN))
    box = browser.evaluate(BOX)
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=box[0] + 0.6 * box[2], y=box[1] + 0.5 * box[3])
    message = browser.evaluate("document.getElementById('message').textContent")
    select(browser, "layer", "0")
    select(browser, "difference", True)
    blend = browser.evaluate("getComputedStyle(document.getElementById('picture')).mixBlendMode")
    select(browser, "difference", False)
    is_right = len({tuple(color) for color in seen}) == 4 and seen[2][0] == seen[2][1] == seen[2][2]
    is_right = is_right and message.split()[0].isdigit() and int(message.split()[0]) > 0 and blend == "difference"
    print(f"{'ok' if is_right else 'BAD':3} layers: {seen}, {message}, {blend}")
    return is_right


def fingers(box, *places):
    """Touches at these shares of the width of a box."""
    return [{"x": box[0] + x * box[2], "y": box[1] + 0.3 * box[3], "id": k} for k, x in enumerate(places)]


def touch(browser):
    """Two fingers that part bring the camera nearer."""
    free = "document.getElementById('views').value === ''"
    box = browser.evaluate(BOX)
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    before = browser.evaluate(MEAN)
    browser.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=fingers(box, 0.65, 0.75))
    browser.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=fingers(box, 0.62, 0.85))
    browser.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=fingers(box, 0.6, 0.95))
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    browser.settle()
    is_right = browser.evaluate(free) and browser.evaluate(MEAN) != before
    print(f"{'ok' if is_right else 'BAD':3} touch moves the camera")
    return is_right


def psnr(browser, picture):
    """Of the canvas against an image file, dB."""
    png = "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode()
    return browser.evaluate(COMPARE.replace("PNG", png))


def hold(browser, *keys, seconds=0.0):
    """Presses keys of the keyboard together, and waits until the camera is still."""
    for kind in ("keyDown", "keyUp"):
        for key in keys:
            text = key if len(key) == 1 and kind == "keyDown" else ""
            browser.call("Input.dispatchKeyEvent", type=kind, key=key, text=text)
        if kind == "keyDown":
            time.sleep(seconds)
    browser.settle()


def camera(browser):
    """Where the camera is: position and rotation."""
    found = browser.evaluate("nightsplat.camera()")
    return found["position"] + found["rotation"]


def camera_after(browser, since):
    """Where the camera is when it moves on, within the time that a busy machine takes for a picture."""
    end = time.monotonic() + 20
    while (now := camera(browser)) == since and time.monotonic() < end:
        time.sleep(0.1)
    return now


def drag(browser, *places):
    """Drags the mouse between places on the canvas, as shares of its size."""
    box = browser.evaluate(BOX)
    kinds = ["mousePressed"] + ["mouseMoved"] * (len(places) - 1)
    for kind, (x, y) in zip(kinds, places):
        at = {"x": box[0] + x * box[2], "y": box[1] + y * box[3]}
        browser.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **at)
    browser.call("Input.dispatchMouseEvent", type="mouseReleased", button="left", clickCount=1, **at)
    browser.settle()


def edits(browser, run, page, folder, size):
    """What is edited in the page is what `edit` makes of the saved list; a saved keyframe is what `render` shows."""
    browser.open(page.as_uri(), face="inspect")
    browser.fit_canvas(*size)
    before = browser.evaluate(MEAN)
    select(browser, "tool", "brush", "input")
    select(browser, "depth", "1", "input")
    drag(browser, (0.7, 0.4), (0.8, 0.5), (0.9, 0.6))
    select(browser, "tool", "sphere", "input")
    select(browser, "sizeX", "0.4", "input")
    browser.evaluate("document.getElementById('apply').click()")
    browser.settle()
    found = browser.evaluate("document.getElementById('edits').textContent")
    after = browser.evaluate(MEAN)
    (folder / "edits.json").write_text(browser.evaluate("JSON.stringify(nightsplat.edits())"))
    edited = folder / "edited.ply"
    run("edit", folder / "run", "--edits", folder / "edits.json", "--out", edited)
    run("render", edited, "--dataset", folder / f"set-{SIZES[0][0]}", "--split", "test", "--out", folder / "edited")
    of_view = psnr(browser, sorted((folder / "edited").rglob("*.png"))[0])
    # A free camera has a centred lens, as frames of a path have.
    hold(browser, "ArrowLeft")
    browser.evaluate("document.getElementById('keyframe').click()")
    browser.settle()
    (folder / "path.json").write_text(browser.evaluate("JSON.stringify(nightsplat.path())"))
    options = ["--path", folder / "path.json", "--frames", 1, "--size", f"{size[0]}x{size[1]}"]
    options += ["--dataset", folder / f"set-{SIZES[0][0]}", "--out", folder / "frames"]
    run("render", folder / "edited.ply", *options)
    frame = sorted((folder / "frames").rglob("*.png"))[0]
    of_path = psnr(browser, frame)
    is_right = min(of_view, of_path) >= ENOUGH and after != before and "delete, crop" in found
    print(f"{'ok' if is_right else 'BAD':3} edits: {of_view:.1f} dB, keyframe: {of_path:.1f} dB; {found}")
    return is_right


def lamp(browser, run, folder, size):
    """With its lamp on, the page of a lamp-lit set is the render whose camera carries it. Other pages have no lamp."""
    absent = browser.evaluate("document.getElementById('lamp').parentElement.hidden")
    width, height = size
    dataset, out = folder / "lit", folder / "run-lit"
    run("synth", dataset, "--lamp", "--views", 16, "--width", width, "--height", height)
    run("train", dataset, "--out", out, "--steps", 200, "--parts", "lamp", "--progress", "none")
    run("export", out, "--format", "html")
    run("render", out, "--split", "test", "--out", folder / "renders-lit", "--lamp")
    failed = 0
    for view, picture in enumerate(sorted((folder / "renders-lit").rglob("*.png"))):
        browser.open((out / "model.html").as_uri(), view)
        browser.fit_canvas(width, height)
        even = psnr(browser, picture)
        select(browser, "lamp", True)
        lit = psnr(browser, picture)
        is_right = absent and lit >= ENOUGH and even < ENOUGH
        print(f"{'ok' if is_right else 'BAD':3} lamp: {lit:.1f} dB with it, {even:.1f} without, {picture.stem}")
        failed += not is_right
    return failed


def live(browser, nightsplat, dataset, run):
    """A page of a training under way, and of its files."""
    failed = 0
    # Software draws a large picture so slowly that a new model waits for it.
    browser.resize(400, 300)
    train = ["train", dataset, "--out", run, "--steps", 100000, "--progress", "none", "--view", 0]
    with Serving(nightsplat, *train) as serving:
        if browser.open(serving.url) != "true":
            raise RuntimeError(browser.evaluate("document.getElementById('message').textContent"))
        first = browser.evaluate("Number(document.documentElement.dataset.version)")
        browser.wait(f"Number(document.documentElement.dataset.version) > {first} + 1")
        browser.evaluate("document.getElementById('pause').click()")
        browser.wait("document.getElementById('progress').textContent.startsWith('paused')")
        browser.evaluate("document.getElementById('pause').click()")
        browser.wait("document.getElementById('progress').textContent.startsWith('training')")
        line = browser.evaluate("document.getElementById('progress').textContent")
        with Serving(nightsplat, "view", run, "--listen", 0) as files:
            browser.evaluate("document.getElementById('save').click()")
            while not (run / "model.ply").exists():
                time.sleep(0.05)
            browser.open(files.url)
            shown = browser.evaluate("Number(document.documentElement.dataset.version)")
            before = (run / "model.ply").stat().st_mtime_ns
            os.kill(serving.process.pid, signal.SIGUSR1)
            while (run / "model.ply").stat().st_mtime_ns == before:
                time.sleep(0.02)
            seconds = browser.wait(f"Number(document.documentElement.dataset.version) > {shown}")
        browser.open(serving.url)
        saved = browser.evaluate(SAVED)
        is_right = saved["name"] == "model.ply" and base64.b64decode(saved["bytes"]) == (run / "model.ply").read_bytes()
        failed += report(is_right, f"the model of a training is downloaded: {len(saved['bytes']) * 3 // 4096} KiB")
        exported = browser.evaluate(EXPORTED)
        (run / "exported.html").write_text(exported)
        browser.evaluate("document.getElementById('stop').click()")
        code = serving.process.wait(PATIENCE)
        browser.wait("document.getElementById('progress').textContent.startsWith('stopped after step')")
        end = browser.evaluate("document.getElementById('progress').textContent")
    is_right = seconds <= 2.0 and code == 130 and "of at most 100000" in line and ", saved; go on with" in end
    failed += report(is_right, f"live: a checkpoint is shown after {seconds:.2f} s; code {code}; {line}; {end}")
    ready = browser.open((run / "exported.html").as_uri())
    is_right = ready == "true" and browser.evaluate("root.dataset.face === 'share' && !element('divider').hidden")
    return failed + report(is_right, f"the page that the live page exports: {len(exported) >> 10} KiB, {ready}")


def report(is_right, line):
    print(f"{'ok' if is_right else 'BAD':3} {line}")
    return not is_right


def center_of(browser, control):
    """The middle of a control on the page."""
    x, y, width, height = browser.evaluate(BOX.replace("canvas", f"element('{control}')"))
    return x + width / 2, y + height / 2


def press(browser, x, y, to=None):
    """Presses the mouse at a place of the page, and releases it there or elsewhere."""
    for kind, (left, top) in (("mousePressed", (x, y)), ("mouseMoved", to or (x, y)), ("mouseReleased", to or (x, y))):
        buttons = 0 if kind == "mouseReleased" else 1
        browser.call("Input.dispatchMouseEvent", type=kind, x=left, y=top, button="left", buttons=buttons, clickCount=1)


def press_key(browser, key, text=""):
    """Types a key as a keyboard does, which also moves the focus and clicks."""
    codes = {"Tab": 9, "Enter": 13, "Escape": 27, "ArrowRight": 39}
    for kind in ("keyDown", "keyUp"):
        typed = {"text": text} if text and kind == "keyDown" else {}
        browser.call(
            "Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=codes[key], **typed
        )


def keyboard_alone(browser, page):
    """Every control of the bar is reached and used without a mouse, with a ring around it; a link carries the look."""
    browser.open(page.as_uri())
    browser.resize(800, 600)
    found, rings = [], []
    for _ in range(8):
        found.append(browser.evaluate("document.activeElement.id"))
        rings.append(browser.evaluate("getComputedStyle(document.activeElement).outlineStyle"))
        press_key(browser, "Tab" if len(found) < 8 else "Enter", "" if len(found) < 8 else "\r")
    opened = browser.evaluate("element('info').open")
    press_key(browser, "Escape")
    back = browser.evaluate("!element('info').open && document.activeElement.id === 'about'")
    bar = ["canvas", "divider", "play", "before", "brightness", "warmth", "fullscreen", "about"]
    # The divider has its ring around the handle.
    is_right = found == bar and set(rings[2:]) == {"solid"} and opened and back
    failed = report(is_right, f"with a keyboard alone: {found}; rings {rings}")

    browser.evaluate("element('brightness').focus()")
    press_key(browser, "ArrowRight")
    browser.settle()
    link, mean = browser.evaluate("location.href"), browser.evaluate(MEAN)
    browser.open(link.partition("#")[0], face=link.partition("#")[2])
    browser.resize(800, 600)
    browser.settle()
    value, again = browser.evaluate("element('brightness').value"), browser.evaluate(MEAN)
    is_right = "brightness=0.05" in link and value == "0.05" and mean == again
    return failed + report(is_right, f"a link carries the look: {link.partition('#')[2]}")


def share(browser, page):
    """The shared face: keys after every control, sliders, flight, the limits of the camera, and both faces."""
    failed = 0
    browser.open(page.as_uri())
    browser.resize(400, 300)
    browser.settle()
    begin, x = camera(browser), center_of(browser, "divider")[0]
    press(browser, *center_of(browser, "divider"), to=(x + 100, 150))
    moved = center_of(browser, "divider")[0] - x
    hold(browser, "w", seconds=0.3)
    after_divider = camera(browser)
    press(browser, *center_of(browser, "brightness"))
    hold(browser, "ArrowLeft", seconds=0.3)
    is_right = abs(moved - 100) < 2 and after_divider != begin and camera(browser) != after_divider
    failed += report(is_right, f"keys after the divider, which moved by {moved:.0f} pixels, and after a slider")

    hold(browser, "r")
    one = [hold(browser, *keys, seconds=0.4) or camera(browser)[:3] for keys in (["d"], ["d", "e"])]
    hold(browser, "r")
    failed += report(one[0] != one[1] and camera(browser) == begin, "keys fly, two together, and R returns")

    colors = {}
    for name, slider, value in (("plain", "warmth", "0"), ("brighter", "brightness", "1"), ("warmer", "warmth", "0.4")):
        select(browser, slider, value, "input")
        colors[name] = browser.evaluate(MEAN)
        select(browser, slider, "0", "input")
    plain, brighter, (red, _, blue) = colors.values()
    is_right = sum(brighter) > 1.2 * sum(plain) and red / blue > 1.2 * plain[0] / plain[2]
    failed += report(is_right and browser.evaluate(MEAN) == plain, f"sliders: {colors}")

    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            browser.call("Input.dispatchMouseEvent", type=kind, x=260, y=120, button="left", clickCount=count)
    browser.settle()
    apart = [abs(a - b) for a, b in zip(camera(browser), begin)]
    failed += report(max(apart[:3]) < 1e-9 < 0.01 < max(apart[3:]), "a double click sets the centre")

    begin = camera(browser)
    browser.evaluate("element('play').click()")
    first = camera_after(browser, begin)
    second = camera_after(browser, first)
    playing = browser.evaluate("element('play').ariaPressed")
    hold(browser, "p")
    failed += report(playing == "true" and begin != first != second, "play moves the camera, and P ends it")

    hold(browser, "r")
    hold(browser, "s", seconds=6)
    away = browser.evaluate("""(() => {
      const { position } = nightsplat.camera(), eyes = scene.cameras.map((own) => add(pose(own).eye, scene.origin));
      const apart = eyes.map((eye) => distance(eye, position)), across = eyes.map((eye) => distance(eye, eyes[0]));
      return Math.min(...apart) / Math.max(...across);
    })()""")
    failed += report(away < 1.0, f"the camera stays near the photographs: {away:.2f} of their extent away")

    hold(browser, "i")
    beside = browser.evaluate("""(() => {
      const a = canvas.getBoundingClientRect(), b = element('panel').getBoundingClientRect();
      return b.width > 0 && (b.left >= a.right || b.top >= a.bottom) && element('bar').hidden;
    })()""")
    hold(browser, "i")
    is_right = beside and browser.evaluate("element('panel').hidden && canvas.clientWidth === innerWidth")
    return failed + report(is_right, "I opens the panel beside the picture, and closes it")


def phone(browser, page):
    """On a phone nothing is cut off, in both faces, and every control has a name."""
    failed = 0
    for face in ("share", "inspect"):
        browser.open(page.as_uri(), face=face)
        browser.resize(360, 640)
        found = browser.evaluate("""(() => {
          const all = [...document.querySelectorAll('button, input, select, [tabindex]')];
          const controls = all.filter((own) => own.checkVisibility());
          const name = (own) => own.ariaLabel || own.textContent.trim() || own.labels?.[0]?.textContent.trim();
          return {
            cut: controls.filter((own) => {
              const { left, right } = own.getBoundingClientRect();
              return left < -14 || right > innerWidth + 14;
            }).map((own) => own.id),
            unnamed: controls.filter((own) => !name(own)).map((own) => own.id),
            overflow: document.documentElement.scrollWidth - innerWidth, count: controls.length,
            canvas: canvas.clientHeight / innerHeight,
          };
        })()""")
        is_right = not found["cut"] and not found["unnamed"] and found["overflow"] <= 0 and found["count"] > 6
        failed += report(is_right and found["canvas"] > 0.5, f"360 pixels wide, {face}: {found}")
    return failed


def tags(browser, run, folder):
    """Title, text, tags and poster of an export, its policy, and its size."""
    page, title = folder / "shared.html", 'The "attic" <1>'
    options = ["--title", title, "--text", "By one candle", "--url", "https://example.org/rooms/", "--max-size", "180K"]
    run("export", folder / "run", "--format", "html", "--views", 1, "--out", page, *options)
    ready = browser.open(page.as_uri())
    found = browser.evaluate("""Object.fromEntries([...document.querySelectorAll('meta[property], meta[name]')]
      .map((own) => [own.getAttribute('property') ?? own.name, own.content]))""")
    policy = browser.evaluate("document.querySelector('meta[http-equiv]').content")
    poster = page.with_suffix(".jpg")
    is_right = ready == "true" and browser.evaluate("document.title") == title
    is_right = is_right and (found["og:title"], found["og:description"]) == (title, "By one candle")
    is_right = is_right and found["og:image"] == "https://example.org/rooms/shared.jpg"
    is_right = is_right and poster.read_bytes()[:2] == b"\xff\xd8" and "unsafe" not in policy and "'none'" in policy
    kib = page.stat().st_size / 1024
    return report(is_right and kib <= 180, f"title and tags: {found}; {kib:.0f} KiB of 180")


def cameras_of_a_dataset(browser, nightsplat, dataset):
    """`view DATASET` shows the cameras; a click on one goes there."""
    with Serving(nightsplat, "view", dataset, "--listen", 0) as serving:
        ready = browser.open(serving.url)
        browser.resize(800, 600)
        hold(browser, "s", seconds=1.0)
        at = browser.evaluate("""(() => {
          const { data } = element('frusta').getContext('2d').getImageData(0, 0, 400, 400);
          const drawn = data.filter((value, k) => k % 4 === 3 && value > 0).length;
          return { drawn, colors: element('canvas').width };
        })()""")
        mean = browser.evaluate(MEAN)
        is_right = ready == "true" and at["drawn"] > 200 and max(mean) > min(mean)
        return report(is_right, f"cameras of a dataset: {at}, points {mean}")


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
                    if browser.open(page.as_uri(), view) != "true":
                        raise RuntimeError(browser.evaluate("document.getElementById('message').textContent"))
                    browser.fit_canvas(width, height)
                    found = psnr(browser, picture)
                    print(f"{'ok' if found >= ENOUGH else 'BAD':3} {found:5.1f} dB  {picture.stem} at {width}x{height}")
                    failed += found < ENOUGH
                if not pictures:
                    raise RuntimeError(f"no renders in {renders}")
            browser.open(page.as_uri(), len(pictures) - 1, "inspect")
            browser.fit_canvas(*SIZES[-1])
            seen = browser.evaluate(GREY)
            # Half floats round by one level.
            is_grey = seen["isShown"] and seen["empty"] in (127, 128) and seen["least"] >= -1 and seen["most"] <= 129
            is_grey = is_grey and seen["opaque"] > 0 and seen["changed"] == 0
            print(f"{'ok' if is_grey else 'BAD':3} before grey: {seen}")
            failed += not is_grey
            browser.open(page.as_uri(), face="inspect")
            failed += not layers(browser)
            failed += not touch(browser)
            failed += lamp(browser, run, folder, SIZES[0])
            failed += not edits(browser, run, page, folder, SIZES[0])
            failed += share(browser, page)
            failed += keyboard_alone(browser, page)
            failed += phone(browser, page)
            failed += tags(browser, run, folder)
            failed += cameras_of_a_dataset(browser, nightsplat, trained)
            failed += bool(browser.complaints)
            print(f"{'BAD' if browser.complaints else 'ok':3} console: {browser.complaints or 'nothing'}")
            failed += live(browser, nightsplat, trained, folder / "live")
        with Browser(program, NO_GL, folder / "profile-without") as browser:
            ready = browser.open(page.as_uri())
            message = browser.evaluate("document.getElementById('message').textContent")
            is_said = ready == "failed" and "no WebGL 2" in message
            print(f"{'ok' if is_said else 'BAD':3} without WebGL: {message}")
            failed += not is_said
    print(f"{'failed: ' + str(failed) if failed else 'every view of the page is the render'}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
