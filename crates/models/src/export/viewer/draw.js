'use strict';
// Draws a model: unpacks it, sorts it by depth, and blends it.

const element = (id) => document.getElementById(id);
const scene = JSON.parse(element('scene').textContent);
const canvas = element('canvas'), root = document.documentElement;
const say = (text) => { element('message').textContent = text; };

// Half floats, decoded once.
const halves = new Float32Array(65536);
for (let i = 0; i < 65536; i++) {
  const exponent = (i >> 10) & 31, fraction = i & 1023;
  const size = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction;
  halves[i] = i >> 15 ? -size : size;
}

// The model within the page.
async function unpack() {
  const text = element('model').textContent;
  element('model').remove();
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Response(stream).arrayBuffer();
}

// Views of a packed model: positions, and all else as half floats.
function opened(buffer) {
  const [count, degree] = new Uint32Array(buffer, 0, 2);
  const means = new Float32Array(buffer, 8, 3 * count);
  return { count, degree, means, rest: new Uint16Array(buffer, 8 + 12 * count) };
}

// Mean and opacity, then the covariance R S S^T R^T, then how well photographs show it.
function geometry({ count, means, rest }, seen) {
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
    data[at + 10] = seen ? seen[i] : 1;
  }
  return data;
}

// Coefficients with an empty fourth channel.
function harmonics({ count, degree, rest }) {
  const data = new Uint16Array(4 * count * (degree + 1) ** 2);
  for (let from = 8 * count, to = 0; to < data.length; from += 3, to += 4) {
    for (let k = 0; k < 3; k++) data[to + k] = rest[from + k];
  }
  return data;
}

// Those that cover most first, by opacity and squared size.
function byImportance(data, count) {
  const seen = new Float32Array(count);
  for (let i = 0; i < count; i++) seen[i] = data[12 * i + 3] * (data[12 * i + 4] + data[12 * i + 7] + data[12 * i + 9]);
  return Uint32Array.from(seen, (_, i) => i).sort((a, b) => seen[b] - seen[a]);
}

// Runs in a worker: sorts the first Gaussians by importance, farthest first, by depth in all its bits: four passes of
// eight.
function sorting() {
  let means, important;
  self.onmessage = ({ data }) => {
    if (data.means) ({ means, important } = data);
    else self.postMessage({ ...data, order: sorted(data.matrix, data.limit) });
  };
  function sorted(m, count) {
    const depths = new Float32Array(count), bits = new Uint32Array(depths.buffer);
    let order = new Uint32Array(count), other = new Uint32Array(count);
    for (let i = 0; i < count; i++) {
      const k = 3 * important[i];
      const depth = m[2] * means[k] + m[5] * means[k + 1] + m[8] * means[k + 2] + m[11];
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
    return order.map((i) => important[i]);
  }
}

// Sorts a model in a worker. `done` is told of each order; the newest request waits for the one under way.
function sorter(done) {
  const worker = new Worker(URL.createObjectURL(new Blob([`(${sorting})()`], { type: 'text/javascript' })));
  let isBusy = false, waiting = null, model = 0;
  const send = (request) => { isBusy = true; worker.postMessage(request); };
  worker.onmessage = ({ data }) => {
    isBusy = false;
    if (waiting) { send(waiting); waiting = null; }
    if (data.model === model) done(data);
  };
  return {
    load: (means, important) => { worker.postMessage({ means, important }); model++; },
    request: (matrix, limit, key) => {
      const request = { matrix, limit, key, model };
      if (isBusy) waiting = request; else send(request);
    },
  };
}

function program(gl, vertex, fragment) {
  const built = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(built, shader);
  }
  gl.linkProgram(built);
  if (!gl.getProgramParameter(built, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(built));
  return built;
}

function unfiltered(gl) {
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  }
}

// A texture at a unit, whose contents are replaced: full rows; what does not fit the device is refused.
function texture(gl, unit, [internal, format, type]) {
  const own = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, own);
  unfiltered(gl);
  return (data) => {
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE), width = Math.min(most, 4096);
    const height = Math.max(1, Math.ceil(data.length / 4 / width));
    if (height > most) throw new Error('the model is too large for this device');
    const padded = new data.constructor(width * height * 4);
    padded.set(data);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, padded);
  };
}

// What the canvas shows: the colour, or a quantity in false colour.
const LAYERS = ['colour', 'depth', 'leftover transmittance', 'number of Gaussians'];
const COUNT_LAYER = 3;

// Everything that draws: give it a model and a camera. `changed` is called when a new order should be drawn.
function renderer(gl, changed) {
  const built = program(gl, element('vertex').textContent, element('fragment').textContent);
  gl.useProgram(built);
  const [geometryTexture, harmonicsTexture] = [
    texture(gl, 0, [gl.RGBA32F, gl.RGBA, gl.FLOAT]), texture(gl, 1, [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT])];
  const places = {};
  const uniform = (name) => places[name] ??= gl.getUniformLocation(built, name);
  gl.uniform1i(uniform('geometry'), 0);
  gl.uniform1i(uniform('harmonics'), 1);
  gl.uniform1f(uniform('near'), scene.near);

  const attribute = (name, width, isId) => {
    const place = gl.getAttribLocation(built, name), target = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, target);
    gl.enableVertexAttribArray(place);
    if (isId) gl.vertexAttribIPointer(place, width, gl.UNSIGNED_INT, 0, 0);
    else gl.vertexAttribPointer(place, width, gl.FLOAT, false, 0, 0);
    gl.vertexAttribDivisor(place, isId ? 1 : 0);
    return target;
  };
  attribute('corner', 2, false);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  const ids = attribute('id', 1, true);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);

  // Sums in half floats where the device blends them: eight bits would round at every splat.
  const fine = gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float');
  const sums = gl.createFramebuffer(), image = gl.createTexture(), shown = copier(gl);
  let size = [0, 0];
  const resize = (width, height) => {
    if (size[0] === width && size[1] === height) return;
    size = [canvas.width, canvas.height] = [width, height];
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, image);
    unfiltered(gl);
    const [internal, type] = fine ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, gl.RGBA, type, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sums);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
  };

  // The order that is drawn, the one that is wanted, and the Gaussians of the model.
  let drawn = { key: '', length: 0 }, wanted = '', count = 0, version = 0, model = null, important = null;
  const sort = sorter(({ key, order }) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, ids);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    drawn = { key, length: order.length };
    changed();
  });

  // Shows another model: in the old order, where it has as many Gaussians, until it is sorted.
  function load(buffer) {
    model = opened(buffer);
    const data = geometry(model, scene.showsCameras ? null : coverage(scene.cameras, model.means, model.count));
    geometryTexture(data);
    harmonicsTexture(harmonics(model));
    gl.useProgram(built);
    gl.uniform1ui(uniform('degree'), model.degree);
    drawn = { key: '', length: drawn.length <= model.count ? drawn.length : 0 };
    important = byImportance(data, model.count);
    restrict(null);
    return model.count;
  }

  // Draws the Gaussians whose `keep` is not 0; null: all.
  function restrict(keep) {
    const shown = keep ? important.filter((i) => keep[i]) : important;
    [count, wanted] = [shown.length, ''];
    version++;
    sort.load(model.means, shown);
    changed();
  }

  function light({ position, axis, ambient, exponent, falloffs, reference_distance: reference, slope, black, reach }) {
    const length = Math.hypot(...axis, 1);
    gl.uniform3fv(uniform('lampPosition'), position);
    gl.uniform3fv(uniform('lampAxis'), [...axis, 1].map((value) => value / length));
    gl.uniform2fv(uniform('lampFalloffs'), falloffs);
    gl.uniform4f(uniform('lampLight'), ambient, exponent, reference, slope);
    gl.uniform2f(uniform('lampTones'), black, reach);
  }

  // Draws at most a share of the Gaussians, the most important ones. `fog` has how much of it there is and the depth at
  // which it ends; `look` changes the colours. Returns whether all that is asked for is drawn.
  function draw(camera, width, height, { grey, layer, share, reach, lamp, fog = [0, 0], look = PLAIN }) {
    resize(width, height);
    const m = camera.viewFromWorld, fit = placed(camera, width, height), limit = Math.ceil(share * count);
    const key = `${version} ${limit} ${m}`;
    if (wanted !== key) { wanted = key; sort.request(m, limit, key); }
    gl.useProgram(built);
    gl.bindBuffer(gl.ARRAY_BUFFER, ids);
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
    gl.uniform2fv(uniform('fog'), fog);
    gl.uniform1i(uniform('layer'), fine ? layer : 0);
    gl.uniform1i(uniform('isLit'), lamp ? 1 : 0);
    if (lamp) light(lamp);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sums);
    gl.viewport(0, 0, width, height);
    if (layer && fine) gl.clearColor(0, 0, 0, 0); else gl.clearColor(grey, grey, grey, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, drawn.length);
    shown(fine ? layer : 0, reach, look);
    return drawn.key === key && limit === count;
  }

  // The sums at a pixel, from the top left.
  function sumsAt(x, y) {
    const values = new Float32Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sums);
    gl.readPixels(x, size[1] - 1 - y, 1, 1, gl.RGBA, gl.FLOAT, values);
    return values;
  }

  return { load, restrict, draw, sumsAt: fine && sumsAt, layers: fine ? LAYERS : LAYERS.slice(0, 1) };
}

// Colours as they are: factors on the light of red, green and blue.
const PLAIN = [1, 1, 1];

// Shows the sums: colours with their look, quantities in colours from blue (0) to red (1).
function copier(gl) {
  const built = program(gl,
    `#version 300 es
     const vec2 c[3] = vec2[](vec2(-1, -1), vec2(3, -1), vec2(-1, 3));
     void main() { gl_Position = vec4(c[gl_VertexID], 0, 1); }`,
    `#version 300 es
     precision highp float;
     uniform sampler2D sums;
     uniform int layer;
     uniform float reach;
     uniform vec3 look;
     out vec4 o;
     vec3 colored(float v) { return clamp(1.5 - abs(4.0 * v - vec3(3.0, 2.0, 1.0)), 0.0, 1.0); }
     // More light bends towards white, which it reaches with the whitest, and clips nothing that was not clipped.
     vec3 graded(vec3 color) {
       vec3 light = pow(clamp(color, 0.0, 1.0), vec3(2.2));
       vec3 bent = light * look / (1.0 + light * max(look - 1.0, 0.0));
       return pow(bent, vec3(1.0 / 2.2));
     }
     void main() {
       vec4 s = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
       vec3 color = look == vec3(1.0) ? s.rgb : graded(s.rgb);
       if (layer == 1) color = s.a < 0.05 ? vec3(0.0) : colored(reach / (reach + s.r / s.a));
       if (layer == 2) color = vec3(1.0 - s.a);
       if (layer == 3) color = s.r < 0.5 ? vec3(0.0) : colored(log2(s.r) / 10.0);
       o = vec4(color, 1);
     }`);
  const empty = gl.createVertexArray();
  const [sums, layerPlace, reachPlace, lookPlace] =
    ['sums', 'layer', 'reach', 'look'].map((name) => gl.getUniformLocation(built, name));
  return (layer, reach, look) => {
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(built);
    gl.uniform1i(sums, 2);
    gl.uniform1i(layerPlace, layer);
    gl.uniform1f(reachPlace, reach);
    gl.uniform3fv(lookPlace, look);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
    gl.enable(gl.BLEND);
  };
}
