#!/usr/bin/env python3
"""Plants defects in the kernels and their wiring, one at a time, and shows which test catches each.

    scripts/plant-defects.py [--every] [PART OF A NAME]

Each defect is one replacement in one file, which is always restored. Its tests are built and run; one of them has to
fail. Exit code 1 if a defect survives, or if the text to replace is no longer there.

--every runs all tests of the program instead of those that the defect names, and writes the table of kills,
target/kills/planted.json: every test that fails for each defect, and the tests that are not needed. It takes hours, and
goes on where it was interrupted: a defect in the table is not planted again until the table is removed.
"""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import kills

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "target/kills/planted.json"

# name, file, text, its replacement, arguments of `cargo test`
DEFECTS = [
    ("the sign of a conic's off-diagonal", "shaders-glsl/splats/render/project.comp",
     "vec3(cov2d.z, -cov2d.y, cov2d.x)", "vec3(cov2d.z, cov2d.y, cov2d.x)", "--test splats golden"),
    ("a compensated opacity has the gradient of the dilated area", "shaders-glsl/include/conic.glsl",
     "float own0 = DILATION * ((yy / area_squared)", "float own0 = DILATION * ((xx / area_squared)",
     "--test splats compensated"),
    ("the smoothing floor is that of the coarsest view", "shaders-glsl/splats/optimizer/smoothing_floor.comp",
     "sampling = min(sampling,", "sampling = max(sampling,", "--test splats floor"),
    ("a frozen quad's neighbour is frozen, too", "shaders-glsl/splats/optimizer/adam.comp",
     "lessThan(i - begin, uvec4(end - begin))", "lessThan(i - (begin + 3), uvec4(end - begin - 3))",
     "--test train freeze::"),
    ("the mean's gradient lacks that through the direction", "shaders-glsl/splats/optimizer/adam_gaussian.comp",
     "gradient.xyz += further;", "", "--test splats gradients::"),
    ("colours at the stride of three channels", "shaders-glsl/include/batch.glsl",
     "mine.color[k] = colors[COLOR_VECTORS * id + k]", "mine.color[k] = colors[id + k]", "--test splats golden"),
    ("the highest and the lowest point of an ellipse are swapped", "shaders-glsl/include/tile.glsl",
     "clamp(vec2(-lowest, lowest)", "clamp(vec2(lowest, -lowest)", "--test splats blending"),
    ("the record of a splat that misses the part is not written", "shaders-glsl/splats/render/blend_backward.comp",
     "is_in_batch && mine.groups == 0", "is_in_batch && mine.groups != 0", "--test splats blending"),
    ("a row of records lacks the last four lanes", "shaders-glsl/include/record_sums.glsl",
     "k < SUBGROUP_SIZE / 4; k++) sum", "k < SUBGROUP_SIZE / 4 - 1; k++) sum", "--test splats blending"),
    ("pixels beyond the right and the lower edge are written", "shaders-glsl/splats/render/blend_forward.comp",
     "if (all(lessThan(pixel, size)))", "if (all(lessThanEqual(pixel, size)))", "--test splats render::"),
    ("the last intersection of a tile is lost", "shaders-glsl/include/tile_run.glsl",
     "intersections_before(tile + 1));", "intersections_before(tile + 1) - 1);", "--test splats render::"),
    ("the other parts of a tile are not asked", "shaders-glsl/splats/render/blend_backward.comp",
     "part < SUBGROUPS_PER_TILE; part++)\n                        sum",
     "part < 1; part++)\n                        sum", "--test splats chain"),
    ("parts of a tile end separately", "shaders-glsl/splats/render/blend_backward.comp",
     "any = any || are_alive[part] != 0;", "any = any && are_alive[part] != 0;", "--test splats done"),
    ("shares are read before all are written", "shaders-glsl/splats/render/blend_backward.comp",
     "            barrier();\n            // The sums", "            // The sums", "--test splats chain"),
    ("the mean's gradient lacks that through depth", "shaders-glsl/include/camera_pinhole.glsl",
     "/ (z * z)\n        - dot(d_xy, free_slope);", "/ (z * z);", "--test splats gradients::"),
    ("a fisheye's gradient lacks that of the azimuth", "shaders-glsl/include/camera_fisheye.glsl",
     " + by_turn * side;", ";", "--test splats renderer_gives"),
    ("guard: points that a fisheye would see twice are culled", "shaders-glsl/include/camera_fisheye.glsl",
     "point.z > 0.0 && angle_off_axis(length(point.xy), point.z) < camera.largest_angle", "point.z > 0.0",
     "--test splats nothing_is_seen"),
    ("every view has the first view's camera", "src/splats/render/cameras.rs",
     "index as u32", "0 * index as u32", "--test train patches::"),
    ("every view has the intersections that are kept for the first", "src/splats/render/cameras.rs",
     "self.lists.get(index)", "self.lists.first()", "--lib train::kept"),
    ("a Gaussian's last record is not summed", "shaders-glsl/splats/render/emit.comp",
     "intersection_ranges[id] = uvec2(begin, last);",
     "intersection_ranges[id] = uvec2(begin, max(last, begin + 1) - 1);", "--test splats gradients::"),
    ("ranks ignore preceding pairs", "shaders-glsl/splats/sort/sort_downsweep.comp",
     "next_place[row_begin + digit] = position + 1;", "next_place[row_begin + digit] = position;",
     "--test splats sort::"),
    ("weights of the transposed convolution are not flipped", "shaders-glsl/networks/conv3x3.comp",
     "(TAPS - 1 - tap)", "tap", "--test networks"),
    ("SSIM's gradient lacks that of the product", "shaders-glsl/include/ssim_window.glsl",
     " + b * d.z;", ";", "--test loss"),
    ("a GPU's derivatives of SSIM count outside the loss region", "shaders-glsl/loss/ssim_forward.comp",
     "d_mean[at] = counts ? d_moments.x : 0.0;", "d_mean[at] = d_moments.x;", "--test loss"),
    ("a GPU's strips of SSIM lack the rows below", "shaders-glsl/loss/ssim_backward.comp",
     "y < strip.end + RADIUS", "y < strip.end", "--test loss"),
    ("partitions of a workgroup begin at the same place", "shaders-glsl/splats/sort/sort_downsweep.comp",
     "position += key_count;", "", "--test splats sort::"),
    ("a sort's counts of the pass before are added to", "shaders-glsl/splats/sort/sort_downsweep.comp",
     "if (counts_next) clear_row(cleared_table);", "", "--test splats sort::"),
    ("SSIM's derivatives count outside the loss region", "shaders-glsl/loss/ssim.comp",
     "derivatives[m][x] = counts ? d_moments[m] : 0.0;", "derivatives[m][x] = d_moments[m];", "--test loss"),
    ("SSIM's windows are incomplete at the ends of a run", "shaders-glsl/loss/ssim.comp",
     "(2 * RADIUS + ALIGNMENT - 1)", "(RADIUS + ALIGNMENT - 1)", "--test loss"),
    ("Gaussians of a later batch take the numbers of the first", "shaders-glsl/splats/render/project.comp",
     "ids[slot] = first + slot;", "ids[slot] = slot;", "--test splats batches::"),
    ("a batch decides for the Gaussians of others", "shaders-glsl/splats/densify/densify_decide.comp",
     "if (i - first_gaussian >= batch_count) return;", "", "--test splats batches::"),
    ("the children of a batch keep its offset", "shaders-glsl/splats/densify/densify_scatter.comp",
     "offsets[i] + copy_index - first_new_gaussian;", "offsets[i] + copy_index;", "--test splats batches::"),
    ("the second moment decays too fast", "shaders-glsl/include/adam_step.glsl",
     "const float BETA2 = 0.999;", "const float BETA2 = 0.99;", "--test splats optimizer::"),
    ("second moments in 16 bits are rounded to nearest", "shaders-glsl/include/adam_step.glsl",
     "+ (chance >> 16);", "+ 0x8000u;", "--test splats decay"),
    ("coefficients in 16 bits are rounded to nearest", "shaders-glsl/include/half.glsl",
     "vec4(chance >> 19) / 8192.0;", "vec4(0.5);", "--test splats precision"),
    ("the other half of a word is read", "shaders-glsl/include/rest.glsl",
     "(first & 1) == 0 ? vec3(low, high.x)", "(first & 1) == 1 ? vec3(low, high.x)", "--test splats represent"),
    ("guard: coefficients stay within 16-bit floats", "shaders-glsl/include/half.glsl",
     "clamp(floor(x / unit + share) * unit, -LARGEST_HALF, LARGEST_HALF)", "floor(x / unit + share) * unit",
     "--test splats beyond"),
    ("the first half of a split keeps its parent's moments", "shaders-glsl/include/densify_action.glsl",
     "return action == ACTION_SPLIT || copy_index > 0;", "return copy_index > 0;", "--test splats densify::"),
    ("a split may change the view of a camera", "shaders-glsl/splats/densify/densify_score.comp",
     "is_candidate && is_safe_to_split(i) ?", "is_candidate ?", "--test splats densify::"),
    ("halves along the ray are not nearer", "shaders-glsl/splats/densify/densify_score.comp",
     "SPLIT_OFFSET * abs(camera_depth_change(mean_in_view, axis_of(view_axes, axis), camera));", "0.0;",
     "--test splats densify::"),
    ("a repeated round makes as many splits", "shaders-glsl/splats/densify/densify_decide.comp",
     "return min(max_added, ", "return min(max_added | ~0u, ", "--test splats densify::"),
    # The guards of the kernels, each removed: docs/measurements.md is their table.
    ("guard: Gaussians behind the near plane are culled", "shaders-glsl/splats/render/project.comp",
     "if (!(depth > near && opacity > ALPHA_MIN)) return;", "if (!(opacity > ALPHA_MIN)) return;",
     "--test splats gaussians"),
    ("guard: an overflow is culled", "shaders-glsl/splats/render/project.comp",
     "if (!(det < 1e30 && all(lessThan(abs(mean2d), vec2(1e30))))) return;", "", "--test splats gaussians"),
    ("guard: the slope of the Jacobian is clamped", "shaders-glsl/include/camera_pinhole.glsl",
     "return clamp(point.xy / point.z, camera.min_slope, camera.max_slope);",
     "return point.xy / point.z;", "--test splats slope"),
    ("a patch counts as a whole view for density control", "crates/core/src/camera/patch.rs",
     "0.5 * share * whole", "0.5 * whole", "--test train add_up"),
    ("a patch limits its Jacobian at its own edges", "src/splats/camera.rs",
     "let margin = JACOBIAN_MARGIN as f32 * whole;",
     "let margin = JACOBIAN_MARGIN as f32 * patch.size.as_vec2();", "--lib splats::camera"),
    ("a patch has the view's principal point", "crates/core/src/camera/patch.rs",
     "camera.principal_point - origin.as_dvec2()", "camera.principal_point", "--test train whole_view_shows"),
    ("guard: distances to a lamp are bounded", "shaders-glsl/include/lamp_falloff.glsl",
     "clamp(at.radius / loaded.reference_distance, LAMP_NEAREST, LAMP_FARTHEST)",
     "(at.radius / loaded.reference_distance)",
     "--test splats lit_colors"),
    ("guard: a lamp has some ambient light", "shaders-glsl/include/lamp_falloff.glsl",
     "loaded.ambient = LAMP_LEAST_AMBIENT + (1.0 - LAMP_LEAST_AMBIENT) * sigmoid(lamp[LAMP_AMBIENT]);",
     "loaded.ambient = sigmoid(lamp[LAMP_AMBIENT]);", "--test splats lit_colors"),
    ("the light of a lamp depends on the place of a Gaussian", "shaders-glsl/include/lamp_falloff.glsl",
     "d_point += d_log_factor * lamp_point_gradient(loaded, at);", "",
     "--test splats gradients"),
    ("guard: huge vectors are scaled before their length", "shaders-glsl/include/rotation.glsl",
     "return length < 1e18 ? 1.0 : 1e-25;", "return 1.0;", "--test cli stress::"),
    ("guard: a quaternion of length zero is the identity", "shaders-glsl/include/rotation.glsl",
     "return norm > 1e-12 ? q / norm : vec4(1.0, 0.0, 0.0, 0.0);", "return q / norm;", "--test splats extreme"),
    ("guard: a quaternion of length zero has no gradient", "shaders-glsl/splats/render/project_backward.comp",
     "norm > 1e-12 ? small *", "true ? small *", "--test splats extreme"),
    ("guard: the complement of an opacity is not a difference", "shaders-glsl/splats/render/project_backward.comp",
     "sigmoid(-parameters[raw_opacity])", "(1.0 - splat.opacity)", "--test cli stress::"),
    ("guard: a gradient that is not finite raises a flag", "shaders-glsl/splats/render/project_backward.comp",
     "if (bits >= 0x7f800000u) {", "if (false) {", "--test splats not_finite::"),
    ("guard: alpha has a largest value", "shaders-glsl/include/splat.glsl",
     "min(ALPHA_MAX, free_alpha)", "free_alpha", "--test splats golden"),
    ("guard: a pixel ends before it is opaque", "shaders-glsl/splats/render/blend_forward.comp",
     "bool is_done = after < TRANSMITTANCE_MIN;", "bool is_done = after < 0.0;", "--test splats transmittance"),
    ("guard: infinite and NaN gradients count as zero", "shaders-glsl/splats/optimizer/adam.comp",
     "vec4 gradient = clamp_gradient(gradients[trained]);", "vec4 gradient = gradients[trained];",
     "--test splats not_finite"),
    ("guard: infinite and NaN gradients of a colour count as zero", "shaders-glsl/splats/optimizer/adam_gaussian.comp",
     "d_color = clamp_gradient(d_color);", "", "--test splats not_finite"),
    ("layout: gradients begin with the vector of the first trained float", "shaders-glsl/include/trained.glsl",
     "return at - 4 * frozen_quads();", "return at - FROZEN_COLUMNS * gaussian_count;", "--test train freeze"),
    ("guard: the square of a gradient is finite", "shaders-glsl/include/adam_step.glsl",
     "vec4 bounded = clamp(gradient, -GRADIENT_BOUND, GRADIENT_BOUND);", "vec4 bounded = gradient;",
     "--test splats huge"),
    ("guard: scales stay within e^-30 and e^13", "shaders-glsl/splats/optimizer/adam.comp",
     "value = mix(value, clamp(value, LOG_SCALE_MIN, LOG_SCALE_MAX), is_log_scale);", "", "--test splats log_scales"),
    ("guard: a curve ends at black and white", "shaders-glsl/include/tone.glsl",
     "return y > 0.0 ? min(y, 1.0) : 0.0;", "return y;", "--test photographs every_family"),
    ("guard: a loss that is not finite raises a flag", "shaders-glsl/include/log_row.glsl",
     "if (!is_finite(means.x) || !is_finite(means.y)) word |= STATUS_NOT_FINITE;", "", "--test loss not_finite"),
    ("guard: variances of SSIM are not negative", "shaders-glsl/include/ssim_window.glsl",
     "max(moments.z - (a * a + b * b), 0.0)", "(moments.z - (a * a + b * b))", "--test loss bright"),
    ("guard: a constant depth has no correlation", "shaders-glsl/loss/depth_correlation.comp",
     "bool is_constant = products.x == 0.0 || products.z == 0.0;", "bool is_constant = false;",
     "--test loss constant_depth"),
    ("guard: exposures stay within the range of centring", "shaders-glsl/loss/exposure/exposure_center.comp",
     "clamp(x, -BOUND, BOUND) * QUANTA", "x * QUANTA", "--test loss centred"),
]


def plant(file, before, after, arguments):
    """The result in words, and the tests that failed; none if the defect was not caught."""
    path = ROOT / file
    original = path.read_text()
    if original.count(before) != 1:
        return f"the text to replace occurs {original.count(before)} times", []
    try:
        path.write_text(original.replace(before, after))
        run = subprocess.run(["cargo", "test", "-q", *arguments.split()], cwd=ROOT, text=True, capture_output=True)
    finally:
        path.write_text(original)
    if "test result" not in run.stdout:
        return "does not build: " + "; ".join(re.findall(r"^error.*", run.stderr, re.M)[:2]), []
    failed = sorted(set(re.findall(r"^test (\S+) \.\.\. FAILED|^---- (\S+) stdout", run.stdout, re.M)))
    names = [name for pair in failed for name in pair if name]
    if run.returncode != 0 and not names:
        names = ["validation, as the process ended"]
    return ", ".join(names) or "SURVIVED", names


def main():
    # As an exception, an interruption restores the file.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
    every = "--every" in sys.argv
    wanted = " ".join(word for word in sys.argv[1:] if word != "--every")
    found = json.loads(TABLE.read_text()) if every and TABLE.exists() else {}
    for name, file, before, after, arguments in DEFECTS:
        if wanted in name and name not in found:
            words = arguments.split()
            said, found[name] = plant(file, before, after, " ".join(words[:2]) if every else arguments)
            print(f"{'caught' if found[name] else 'MISSED'}  {name} ({file}): {said}", flush=True)
            if every:
                kills.save(TABLE, {name: failed for name, failed in found.items() if failed})
    if every:
        kills.show(TABLE, found)
    survivors = sum(not failed for failed in found.values())
    sys.exit(survivors > 0)


if __name__ == "__main__":
    main()
