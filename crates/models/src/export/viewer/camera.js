// Cameras: their axes, the lens on the canvas, and the region in which photographs were taken.

const add = (a, b, s = 1) => a.map((v, k) => v + s * b[k]);
const dot = (a, b) => a.reduce((sum, v, k) => sum + v * b[k], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const mix = (a, b, t) => a.map((v, k) => v + t * (b[k] - v));
const distance = (a, b) => Math.hypot(...add(a, b, -1));
const clamp = (value, least, most) => Math.max(least, Math.min(most, value));
const AXES = ['right', 'down', 'forward'];
const rotate = (v, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(v, axis) * (1 - c), side = cross(axis, v);
  return v.map((value, k) => value * c + side[k] * s + axis[k] * along);
};

// Right, down and forward in the world, and the eye.
function pose({ viewFromWorld: m }) {
  const row = (k) => [m[k], m[3 + k], m[6 + k]];
  const [right, down, forward] = [row(0), row(1), row(2)];
  const eye = [0, 1, 2].map((k) => -(right[k] * m[9] + down[k] * m[10] + forward[k] * m[11]));
  return { right, down, forward, eye };
}

function matrix({ right, down, forward, eye }) {
  const columns = [0, 1, 2].flatMap((k) => [right[k], down[k], forward[k]]);
  return [...columns, -dot(right, eye), -dot(down, eye), -dot(forward, eye)];
}

// The rotation (w, x, y, z) that maps the axes of the camera to the world.
function quaternion({ right, down, forward }) {
  const [a, b, c] = [right[0], down[1], forward[2]];
  const largest = [1 + a + b + c, 1 + a - b - c, 1 + b - a - c, 1 + c - a - b];
  const [wx, wy, wz] = [down[2] - forward[1], forward[0] - right[2], right[1] - down[0]];
  const [xy, xz, yz] = [down[0] + right[1], forward[0] + right[2], forward[1] + down[2]];
  const rows = [[largest[0], wx, wy, wz], [wx, largest[1], xy, xz], [wy, xy, largest[2], yz], [wz, xz, yz, largest[3]]];
  // The row with the largest element divides by no small number.
  const row = rows[largest.indexOf(Math.max(...largest))], length = Math.hypot(...row);
  return row.map((v) => v / length);
}

// Between two poses; 0: the first.
function between(from, to, t) {
  const [a, b] = [quaternion(from), quaternion(to)];
  // Both signs are the same rotation; the nearer one gives the shorter way.
  const [w, x, y, z] = mix(a, dot(a, b) < 0 ? b.map((v) => -v) : b, t), s = 2 / (w * w + x * x + y * y + z * z);
  return {
    right: [1 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)],
    down: [s * (x * y - w * z), 1 - s * (x * x + z * z), s * (y * z + w * x)],
    forward: [s * (x * z + w * y), s * (y * z - w * x), 1 - s * (x * x + y * y)],
    eye: mix(from.eye, to.eye, t),
  };
}

const smooth = (t) => { const s = clamp(t, 0, 1); return s * s * (3 - 2 * s); };

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

// A shared page may crop a picture to this share of its width or height, so that it fills the window.
const LEAST_SHOWN = 0.62;
let fills = false;

// Where a camera's image lies on the canvas: in the middle, as large as fits, or larger where it may be cropped.
function placed(camera, width, height) {
  const ratios = [width / camera.size[0], height / camera.size[1]].sort((a, b) => a - b);
  const zoom = fills ? Math.min(ratios[1], ratios[0] / LEAST_SHOWN) : ratios[0];
  return { zoom, left: (width - zoom * camera.size[0]) / 2, top: (height - zoom * camera.size[1]) / 2 };
}

// A camera that looks at a point, upright.
function looking(eye, target) {
  const away = add(target, eye, -1), forward = away.map((v) => v / Math.hypot(...away));
  const side = cross(forward, scene.up), right = side.map((v) => v / Math.hypot(...side));
  return { eye, forward, right, down: cross(forward, right) };
}

// A camera that sees all the others and what they look at, from outside and above; and the point that it looks at.
function overview(poses, home) {
  const middle = [0, 1, 2].map((k) => poses.reduce((sum, { eye }) => sum + eye[k], 0) / poses.length);
  const extent = Math.max(...poses.map(({ eye }) => distance(eye, home)));
  const out = add(middle, home, -1), level = add(out, scene.up, -dot(out, scene.up)), length = Math.hypot(...level);
  const side = length > 0.1 * extent ? level.map((v) => v / length) : poses[0].right;
  const target = mix(home, middle, 0.4);
  return [looking(add(add(home, side, 1.9 * extent), scene.up, 1.1 * extent), target), target];
}

// Where a camera sees points as the photographs do: near their cameras, and along the lines of sight.
function photographedRegion(poses, target) {
  const away = poses.map(({ eye }) => distance(eye, target)).sort((a, b) => a - b)[poses.length >> 1];
  const lines = poses.map(({ eye, forward }) => {
    const ahead = dot(add(target, eye, -1), forward);
    return { eye, forward, length: 0.75 * (ahead > 0 ? ahead : away / 2) };
  });
  const radius = Math.max(0.4 * away, 2 * scene.near);
  const nearest = (point) => {
    let best = { apart: Infinity };
    for (const { eye, forward, length } of lines) {
      const on = add(eye, forward, clamp(dot(add(point, eye, -1), forward), 0, length)), apart = distance(point, on);
      if (apart < best.apart) best = { apart, on };
    }
    return best;
  };
  return {
    // 0: within; 1: at the limit.
    edge: (point) => clamp(nearest(point).apart / radius * 2 - 1, 0, 1),
    // The way to a point as far as it may go; from outside, no further away.
    limited: (from, to) => {
      const { apart, on } = nearest(to), most = Math.max(radius, nearest(from).apart);
      return apart <= most ? to : mix(on, to, most / apart);
    },
  };
}

// How well the photographs show each point, from 0, outside of all of them, to 1.
function coverage(cameras, means, count) {
  const seen = new Float32Array(count);
  for (const { viewFromWorld: m, size, focal, principalPoint } of cameras) {
    for (let i = 0; i < count; i++) {
      if (seen[i] >= 1) continue;
      const x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
      const depth = m[2] * x + m[5] * y + m[8] * z + m[11];
      if (!(depth > scene.near)) continue;
      const u = focal[0] * (m[0] * x + m[3] * y + m[6] * z + m[9]) / depth + principalPoint[0];
      const v = focal[1] * (m[1] * x + m[4] * y + m[7] * z + m[10]) / depth + principalPoint[1];
      // Full within the photograph, and none at a fifth of its size outside.
      const outside = Math.max(-u / size[0], u / size[0] - 1, -v / size[1], v / size[1] - 1);
      seen[i] = Math.max(seen[i], clamp(1 - 5 * outside, 0, 1));
    }
  }
  return seen;
}
