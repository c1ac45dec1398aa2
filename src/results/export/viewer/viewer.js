'use strict';
// The viewer: unpacks the model, sorts it by depth, draws it, and moves the camera.
(() => {
  const element = (id) => document.getElementById(id);
  const scene = JSON.parse(element('scene').textContent);
  const canvas = element('canvas');
  const say = (text) => { element('message').textContent = text; };

  // Half floats, decoded once.
  const halves = new Float32Array(65536);
  for (let i = 0; i < 65536; i++) {
    const exponent = (i >> 10) & 31, fraction = i & 1023;
    const size = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction;
    halves[i] = i >> 15 ? -size : size;
  }

  async function unpack() {
    const text = element('model').textContent;
    element('model').remove();
    const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'));
    return new Response(stream).arrayBuffer();
  }

  // Textures of full rows; what does not fit the device is refused.
  function texture(gl, unit, texels, [internal, format, type], data) {
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE), width = Math.min(most, 4096);
    const height = Math.max(1, Math.ceil(texels / width));
    if (height > most) throw new Error('the model is too large for this device');
    const channels = data.length / Math.max(1, texels);
    const padded = new data.constructor(width * height * (channels || 4));
    padded.set(data);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, padded);
  }

  // Mean and opacity, then the covariance R S S^T R^T.
  function geometry(means, rest, count) {
    const data = new Float32Array(12 * count);
    const scales = count, quats = 4 * count;
    for (let i = 0; i < count; i++) {
      const at = 12 * i;
      const [w, x, y, z] = [0, 1, 2, 3].map((k) => halves[rest[quats + 4 * i + k]]);
      const turn = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
      const square = [0, 1, 2].map((k) => Math.exp(2 * halves[rest[scales + 3 * i + k]]));
      const entry = (a, b) => square.reduce((sum, s, k) => sum + turn[3 * a + k] * s * turn[3 * b + k], 0);
      data.set(means.subarray(3 * i, 3 * i + 3), at);
      data[at + 3] = 1 / (1 + Math.exp(-halves[rest[i]]));
      data.set([entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)], at + 4);
    }
    return data;
  }

  // Coefficients with an empty fourth channel.
  function harmonics(rest, count, coefficients) {
    const data = new Uint16Array(4 * count * coefficients);
    for (let from = 8 * count, to = 0; to < data.length; from += 3, to += 4) {
      for (let k = 0; k < 3; k++) data[to + k] = rest[from + k];
    }
    return data;
  }

  // Farthest first, by depth in all its bits: four passes of eight.
  function sorter(means, count) {
    const depths = new Float32Array(count), bits = new Uint32Array(depths.buffer);
    let order = new Uint32Array(count), other = new Uint32Array(count);
    return (m) => {
      for (let i = 0; i < count; i++) {
        const depth = m[2] * means[3 * i] + m[5] * means[3 * i + 1] + m[8] * means[3 * i + 2] + m[11];
        depths[i] = depth > 0 ? depth : 0;
        order[i] = i;
      }
      for (let shift = 0; shift < 32; shift += 8) {
        const place = new Uint32Array(257);
        for (let i = 0; i < count; i++) place[256 - ((bits[i] >>> shift) & 255)]++;
        for (let k = 1; k < 257; k++) place[k] += place[k - 1];
        for (let k = 0; k < count; k++) other[place[255 - ((bits[order[k]] >>> shift) & 255)]++] = order[k];
        [order, other] = [other, order];
      }
      return order;
    };
  }

  function program(gl) {
    const built = gl.createProgram();
    for (const [kind, id] of [[gl.VERTEX_SHADER, 'vertex'], [gl.FRAGMENT_SHADER, 'fragment']]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, element(id).textContent);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(built, shader);
    }
    gl.linkProgram(built);
    if (!gl.getProgramParameter(built, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(built));
    gl.useProgram(built);
    return built;
  }

  // Everything that draws: give it a camera.
  function renderer(gl, buffer) {
    const { count, shDegree } = scene, coefficients = (shDegree + 1) ** 2;
    const means = new Float32Array(buffer, 0, 3 * count), rest = new Uint16Array(buffer, 12 * count);
    const built = program(gl), sort = sorter(means, count);
    texture(gl, 0, 3 * count, [gl.RGBA32F, gl.RGBA, gl.FLOAT], geometry(means, rest, count));
    texture(gl, 1, coefficients * count, [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT], harmonics(rest, count, coefficients));
    const places = {};
    const uniform = (name) => places[name] ??= gl.getUniformLocation(built, name);
    gl.uniform1i(uniform('geometry'), 0);
    gl.uniform1i(uniform('harmonics'), 1);
    gl.uniform1ui(uniform('degree'), shDegree);
    gl.uniform1f(uniform('near'), scene.near);

    const attribute = (name, data, width, isId) => {
      const place = gl.getAttribLocation(built, name), target = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, target);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(place);
      if (isId) gl.vertexAttribIPointer(place, width, gl.UNSIGNED_INT, 0, 0);
      else gl.vertexAttribPointer(place, width, gl.FLOAT, false, 0, 0);
      gl.vertexAttribDivisor(place, isId ? 1 : 0);
      return target;
    };
    attribute('corner', new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), 2, false);
    const ids = attribute('id', new Uint32Array(count), 1, true);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);

    // Sums in half floats where the device blends them: eight bits would round at every splat.
    const fine = gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float');
    const sums = fine && gl.createFramebuffer(), image = fine && gl.createTexture();
    const shown = fine && copier(gl);
    let size = [0, 0];
    const resize = (width, height) => {
      if (size[0] === width && size[1] === height) return;
      size = [canvas.width, canvas.height] = [width, height];
      if (!fine) return;
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, image);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
      gl.bindFramebuffer(gl.FRAMEBUFFER, sums);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
    };

    return (camera, width, height, grey) => {
      resize(width, height);
      const m = camera.viewFromWorld, fit = placed(camera, width, height);
      gl.useProgram(built);
      gl.bindBuffer(gl.ARRAY_BUFFER, ids);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, sort(m));
      const eye = [0, 1, 2].map((k) => -(m[3 * k] * m[9] + m[3 * k + 1] * m[10] + m[3 * k + 2] * m[11]));
      gl.uniformMatrix4fv(uniform('viewFromWorld'), false,
        [m[0], m[1], m[2], 0, m[3], m[4], m[5], 0, m[6], m[7], m[8], 0, m[9], m[10], m[11], 1]);
      gl.uniform3fv(uniform('eye'), eye);
      // At the size that is drawn: the widening by a fraction of a pixel is of its pixels.
      gl.uniform2fv(uniform('focal'), camera.focal.map((value) => value * fit.zoom));
      gl.uniform2fv(uniform('principalPoint'), camera.principalPoint.map((value) => value * fit.zoom));
      gl.uniform2fv(uniform('size'), camera.size.map((value) => value * fit.zoom));
      gl.uniform2f(uniform('offset'), fit.left, fit.top);
      gl.uniform2f(uniform('scale'), 2 / width, -2 / height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, fine ? sums : null);
      gl.viewport(0, 0, width, height);
      gl.clearColor(grey, grey, grey, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
      if (fine) shown();
    };
  }

  // Shows the sums.
  function copier(gl) {
    const built = gl.createProgram();
    const sources = [
      [gl.VERTEX_SHADER, 'const vec2 c[3] = vec2[](vec2(-1, -1), vec2(3, -1), vec2(-1, 3)); void main() { gl_Position = vec4(c[gl_VertexID], 0, 1); }'],
      [gl.FRAGMENT_SHADER, 'precision highp float; uniform sampler2D sums; out vec4 o; void main() { o = vec4(texelFetch(sums, ivec2(gl_FragCoord.xy), 0).rgb, 1); }']];
    for (const [kind, source] of sources) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, '#version 300 es\n' + source);
      gl.compileShader(shader);
      gl.attachShader(built, shader);
    }
    gl.linkProgram(built);
    const empty = gl.createVertexArray();
    return () => {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.useProgram(built);
      gl.uniform1i(gl.getUniformLocation(built, 'sums'), 2);
      gl.disable(gl.BLEND);
      gl.bindVertexArray(empty);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      gl.bindVertexArray(null);
      gl.enable(gl.BLEND);
    };
  }

  // Where a view lies in the canvas: as large as fits, in the middle.
  function placed(camera, width, height) {
    const zoom = Math.min(width / camera.size[0], height / camera.size[1]);
    return { zoom, left: (width - zoom * camera.size[0]) / 2, top: (height - zoom * camera.size[1]) / 2 };
  }

  // --- The camera ------------------------------------------------------------------------------------------------------

  const add = (a, b, s = 1) => a.map((v, k) => v + s * b[k]);
  const dot = (a, b) => a.reduce((sum, v, k) => sum + v * b[k], 0);
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const rotate = (v, axis, angle) => {
    const c = Math.cos(angle), s = Math.sin(angle), along = dot(v, axis) * (1 - c), side = cross(axis, v);
    return v.map((value, k) => value * c + side[k] * s + axis[k] * along);
  };

  // Right, down and forward in the world, and the eye.
  function pose(view) {
    const m = view.viewFromWorld, row = (k) => [m[k], m[3 + k], m[6 + k]];
    const [right, down, forward] = [row(0), row(1), row(2)];
    const eye = [0, 1, 2].map((k) => -(right[k] * m[9] + down[k] * m[10] + forward[k] * m[11]));
    return { right, down, forward, eye };
  }

  function matrix({ right, down, forward, eye }) {
    const columns = [0, 1, 2].flatMap((k) => [right[k], down[k], forward[k]]);
    return [...columns, -dot(right, eye), -dot(down, eye), -dot(forward, eye)];
  }

  // The point nearest to all optical axes.
  function center(poses) {
    const a = [0, 0, 0, 0, 0, 0, 0, 0, 0], b = [0, 0, 0];
    for (const { forward, eye } of poses) {
      for (let i = 0; i < 3; i++) {
        for (let j = 0; j < 3; j++) {
          const entry = (i === j ? 1 : 0) - forward[i] * forward[j];
          a[3 * i + j] += entry;
          b[i] += entry * eye[j];
        }
      }
    }
    const column = (k) => [a[k], a[3 + k], a[6 + k]];
    const determinant = dot(column(0), cross(column(1), column(2)));
    const first = poses[0];
    return Math.abs(determinant) < 1e-9 * poses.length ** 3
      ? add(first.eye, first.forward, 10 * scene.near)
      : [dot(b, cross(column(1), column(2))), dot(column(0), cross(b, column(2))), dot(column(0), cross(column(1), b))]
        .map((value) => value / determinant);
  }

  function start(draw) {
    const views = scene.views, poses = views.map(pose);
    const down = scene.up.map((value) => -value);
    let current = { ...poses[0] }, bookmark = 0, lens = views[0], target = center(poses), pending = false;
    // How much of the view its picture covers, the view's left edge and width on the page, and the last bookmark.
    let share = 0.5, across = [0, 1], last = 0;
    const asked = /^#view=(\d+)$/.exec(location.hash);
    const reach = () => Math.max(Math.hypot(...add(target, current.eye, -1)), 2 * scene.near);

    const camera = () => (bookmark === null ? freed() : views[bookmark]);
    // A free camera fills the canvas with the first view's angle.
    const freed = () => {
      const { clientWidth: w, clientHeight: h } = canvas, s = Math.min(w / lens.size[0], h / lens.size[1]);
      return { size: [w, h], focal: lens.focal.map((f) => f * s), principalPoint: [w / 2, h / 2], viewFromWorld: matrix(current) };
    };
    const paint = () => {
      pending = false;
      const ratio = window.devicePixelRatio || 1;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
      // Before grey, what black hides is seen: holes.
      draw(camera(), width, height, element('grey').checked ? 0.5 : 0);
      compare(ratio);
    };
    const refresh = () => { if (!pending) { pending = true; requestAnimationFrame(paint); } };

    // The picture of the view lies over the left part of the model.
    const compare = () => {
      const picture = bookmark === null ? null : views[bookmark].pictures[element('compare').value];
      element('overlay').hidden = element('divider').hidden = !picture;
      if (!picture) return;
      const fit = placed(views[bookmark], canvas.clientWidth, canvas.clientHeight);
      const [width, height] = views[bookmark].size.map((v) => v * fit.zoom);
      across = [fit.left, width];
      Object.assign(element('overlay').style,
        { left: fit.left + 'px', top: fit.top + 'px', width: share * width + 'px', height: height + 'px' });
      Object.assign(element('divider').style,
        { left: fit.left + share * width + 'px', top: fit.top + 'px', height: height + 'px' });
      element('divider').setAttribute('aria-valuenow', Math.round(100 * share));
      const image = element('picture');
      if (image.src !== picture.image) image.src = picture.image;
      Object.assign(image.style, { width: width + 'px', height: height + 'px' });
      element('leftText').textContent = picture.label;
    };
    const choose = (index) => {
      bookmark = index;
      if (index !== null) last = index;
      element('return').disabled = index !== null;
      element('views').value = index === null ? '' : String(index);
      const before = element('compare').value, list = element('compare');
      list.replaceChildren(new Option('model alone', ''));
      if (index !== null) {
        current = { ...poses[index] };
        lens = views[index];
        views[index].pictures.forEach(({ label }, k) => list.add(new Option(label, String(k))));
        list.value = views[index].pictures[before] ? before : '';
      }
      refresh();
    };
    const free = () => { if (bookmark !== null) choose(null); };
    const back = () => { target = center(poses); choose(last); };
    // As the page opens: the photograph, which is dark, over the left half of the model.
    const reset = () => {
      share = 0.5;
      element('grey').checked = false;
      last = asked && views[asked[1]] ? Number(asked[1]) : 0;
      back();
      if (views[last].pictures.length) element('compare').value = '0';
      canvas.focus({ preventScroll: true });
    };
    const divide = (value) => { share = Math.max(0, Math.min(1, value)); compare(); };
    const fill = () => {
      if (document.fullscreenElement) document.exitFullscreen();
      else document.documentElement.requestFullscreen?.().catch(() => {});
    };

    // Dragging turns about the target, upright; moving takes the target along.
    const turn = (x, y) => {
      free();
      const about = (axis, angle) => {
        const arm = rotate(add(current.eye, target, -1), axis, angle);
        current.eye = add(target, arm);
        for (const key of ['right', 'down', 'forward']) current[key] = rotate(current[key], axis, angle);
      };
      about(down, x);
      const level = dot(current.forward, down);
      if (!(level > 0.98 && y > 0) && !(level < -0.98 && y < 0)) about(current.right, y);
      refresh();
    };
    const look = (x, y) => {
      free();
      for (const [axis, angle] of [[down, x], [current.right, y]]) {
        for (const key of ['right', 'down', 'forward']) current[key] = rotate(current[key], axis, angle);
      }
      target = add(current.eye, current.forward, reach());
      refresh();
    };
    const move = (x, y, z) => {
      free();
      const step = [0, 1, 2].map((k) => x * current.right[k] + y * current.down[k] + z * current.forward[k]);
      current.eye = add(current.eye, step);
      target = add(target, step);
      refresh();
    };
    const approach = (factor) => {
      free();
      current.eye = add(target, add(current.eye, target, -1), factor);
      refresh();
    };

    const pointers = new Map();
    let spread = 0;
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
      spread = 0;
    });
    for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener('pointermove', (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      pointers.set(event.pointerId, event);
      const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
      const pixel = reach() / (lens.focal[1] * Math.min(canvas.clientWidth / lens.size[0], canvas.clientHeight / lens.size[1]));
      if (pointers.size > 1) {
        const [a, b] = [...pointers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) approach(spread / now);
        spread = now;
        move(-x * pixel / 2, -y * pixel / 2, 0);
      } else if (event.buttons & 2 || event.shiftKey) move(-x * pixel, -y * pixel, 0);
      else turn(x * 0.006, -y * 0.006);
    });
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      approach(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 500))));
    }, { passive: false });
    const keys = {
      w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, -1, 0], q: [0, 1, 0],
    };
    const commands = { g: 'grey', r: 'return', f: 'fullscreen', home: 'reset' };
    // Wherever the focus is, but for controls that have keys of their own.
    document.addEventListener('keydown', (event) => {
      if (event.target.closest?.('select, #divider')) return;
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const step = keys[event.key.toLowerCase()], turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (step) move(...step.map((v) => 0.03 * reach() * v));
      else if (turns) look(turns[0] * 0.04, turns[1] * 0.04);
      else if (commands[event.key.toLowerCase()]) element(commands[event.key.toLowerCase()]).click();
      else return;
      event.preventDefault();
    });

    element('views').append(new Option('free', ''), ...views.map(({ name }, k) => new Option(name, String(k))));
    element('views').addEventListener('change', ({ target: { value } }) => choose(value === '' ? null : Number(value)));
    for (const id of ['compare', 'grey']) element(id).addEventListener('change', refresh);
    for (const [id, act] of [['return', back], ['reset', reset], ['fullscreen', fill]]) element(id).addEventListener('click', act);
    const divider = element('divider');
    divider.addEventListener('pointerdown', (event) => divider.setPointerCapture(event.pointerId));
    divider.addEventListener('pointermove', (event) => {
      if (divider.hasPointerCapture(event.pointerId)) divide((event.clientX - canvas.getBoundingClientRect().left - across[0]) / across[1]);
    });
    divider.addEventListener('keydown', (event) => {
      const to = { ArrowLeft: share - 0.05, ArrowRight: share + 0.05, Home: 0, End: 1 }[event.key];
      if (to === undefined) return;
      divide(to);
      event.preventDefault();
    });
    element('provenance').append(...[...scene.provenance, `${scene.count} Gaussians`].map((line) => {
      const item = document.createElement('li');
      item.textContent = line;
      return item;
    }));
    new ResizeObserver(refresh).observe(canvas);
    reset();
    paint();
  }

  async function open() {
    const gl = canvas.getContext('webgl2', { antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error('this browser has no WebGL 2; turn hardware acceleration on, or open model.ply in another viewer');
    start(renderer(gl, await unpack()));
    say('');
    document.documentElement.dataset.ready = 'true';
  }
  open().catch((error) => {
    say(`The model cannot be shown: ${error.message}`);
    document.documentElement.dataset.ready = 'failed';
  });
})();
