#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_subgroup_uniform_control_flow : require
#extension GL_KHR_memory_scope_semantics : require
#include "kernel.glsl"
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "splat.glsl"
#include "tile.glsl"
#include "segments.glsl"

//! Blend backward: a tile's subgroups, most often one, write the gradient record of every intersection to its slot.
//!
//! Walks front to back again, as the forward pass did, with the light still to come, L_i = sum_{k >= i} c_k alpha_k
//! T_k + T background, which starts as the render itself: -alpha_i dC / dalpha_i = alpha_i / (1 - alpha_i) L_(i + 1) -
//! c_i alpha_i T_i. Of both terms, the product with dL/dC is all that is needed: one number a pixel, however many
//! channels. The gradients of the ellipse are multiples of moments, sums of dL/dsigma times powers of the offset. No
//! atomics: a slot is written by the one tile it belongs to, and the sums over a tile's lanes and parts and over a
//! Gaussian's slots come in a fixed order.
//!
//! Where long runs have segments, the first workgroups have the first segment of every tile, the others one for each
//! block of intersections, and with it at most one further segment.

// This many channels, from the first, move and shape the splats; of the others only the colours learn. 0: so of all,
// and the moments are zeros.
layout(constant_id = 8) const uint SHAPING_CHANNELS = 3;
// 1: so does the last channel, the mean depth z = sum_i z_i w_i / alpha. The gradient of a weight is d_z / alpha (z_i -
// z): that of a sum of weighted depths with z as its background, whose gradient is d_z / alpha.
layout(constant_id = 11) const uint VIEW_DEPTHS = 0;

// A function, as `tile_is_shared`.
bool any_shapes() {
    uint channels = SHAPING_CHANNELS;
    return channels > 0;
}

bool shapes(uint channel) {
    return any_shapes() && (channel < SHAPING_CHANNELS || channel >= CHANNELS - VIEW_DEPTHS);
}

layout(push_constant, scalar) uniform Params { uvec2 size; uint tile_columns; uint tile_count; };

layout(binding = 0) readonly  buffer Ranges  { uvec2 tile_ranges[]; };
layout(binding = 1) readonly  buffer IntersectionIds   { uint sorted_intersections[]; };
layout(binding = 2) readonly  buffer GaussianIds  { uint gaussian_ids[]; };
layout(binding = 3) readonly  buffer Splats  { ProjectedSplat splats[]; };
layout(binding = 4) readonly  buffer Colors  { vec4 colors[]; };  // (Gaussians, COLOR_VECTORS)
layout(binding = 5) readonly  buffer Render  { float render[]; };    // (CHANNELS, H, W)
layout(binding = 6) readonly  buffer DRender { float d_render[]; };  // (CHANNELS, H, W); of the depth, over alpha
// (slots, RECORD_VECTORS): moments and magnitudes of dL/dsigma RECORD_HEAD, gradients of the colour CHANNELS, zeros
layout(binding = 7) writeonly buffer GradientRecords { vec4 gradient_records[]; };
layout(binding = 8) readonly  buffer Counts  { uint counts[]; };  // [0]: intersections
layout(binding = 9) readonly  buffer Tiles   { uint sorted_tiles[]; };
layout(binding = 10) readonly buffer SegmentStates { float segment_states[]; };  // include/segments.glsl

#include "batch.glsl"
#include "record_sums.glsl"

const uint RECORD_FLOATS = 4 * RECORD_VECTORS;
// (parts, BATCH, RECORD): the records of a batch; without use where a tile has one part.
shared float shares[(SUBGROUPS_PER_TILE - 1 / SUBGROUPS_PER_TILE) * BATCH * RECORD + 1];
shared uint are_alive[SUBGROUPS_PER_TILE];

// Whether the gradients of a splat's colours are summed over the groups when these are done, from their weights: narrow
// subgroups do not have the registers for the colours and their gradients at once. A function, as `tile_is_shared`.
bool sums_colors_last() {
    uint lanes = SUBGROUP_SIZE;
    return tile_is_shared() && CHANNELS > lanes;
}

// Whether any lane of any part says so; every lane has to ask.
bool tile_any(bool says) {
    bool any = subgroupAny(says);
    if (tile_is_shared()) {
        if (subgroupElect()) are_alive[gl_SubgroupID] = uint(any);
        barrier();
        for (uint part = 0; part < SUBGROUPS_PER_TILE; part++) any = any || are_alive[part] != 0;
    }
    return any;
}

// The values of a record that a part stores: parts do not share what fills up the last vector.
uint stored_values() { return tile_is_shared() ? RECORD : RECORD_FLOATS; }

// A value of the sum of a record over the part.
void store_sum(uint slot, uint value, float sum) {
    if (tile_is_shared()) shares[(gl_SubgroupID * BATCH + slot) * RECORD + value] = sum;
    else gradient_records[RECORD_VECTORS * slot + value / 4][value % 4] = sum;
}

// The record of a splat that misses the part, by one lane.
void store_no_record(uint slot) {
    if (tile_is_shared()) {
        for (uint value = 0; value < RECORD; value++) store_sum(slot, value, 0.0);
    } else {
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) gradient_records[RECORD_VECTORS * slot + k] = vec4(0.0);
    }
}

// Stores the sums of `count` rows of records in shared memory, those of the splats of the batch from `first` on.
void store_row_sums(uint first, uint count) {
    order_shared_memory();
    uint lane = gl_SubgroupInvocationID;
    [[unroll]] for (uint i = 0; i < ROWS * RECORD; i += SUBGROUP_SIZE) {
        uint row = (i + lane) / RECORD, value = (i + lane) % RECORD;
        if (row < count) store_sum(staged_slot(first + row), value, row_sum(i + lane));
    }
    // What fills up the last vector, so that memory is written whole.
    uint row = lane / 4, value = RECORD_FLOATS - 4 + lane % 4;
    uint filled = tile_is_shared() ? 0 : count;
    if (row < filled && value >= RECORD) store_sum(staged_slot(first + row), value, 0.0);
    order_shared_memory();
}

// The tile of this workgroup and its intersections; none where the block has no start of a segment.
uvec2 segment_of(out uint tile) {
    tile = WORKGROUP_INDEX;
    uvec2 range = uvec2(0);
    if (SEGMENT == 0) return tile < tile_count ? tile_ranges[tile] : range;
    if (tile < tile_count) {
        range = tile_ranges[tile];
    } else {
        uint begin = (tile - tile_count) * SEGMENT;
        tile = begin < counts[0] ? sorted_tiles[begin] : tile_count;
        if (tile >= tile_count) return range;
        range = tile_ranges[tile];
        uint start = range.x + (begin - range.x + SEGMENT - 1) / SEGMENT * SEGMENT;
        range.x = start == range.x ? range.y : min(start, range.y);
    }
    range.y = min(range.y, range.x + SEGMENT);
    return range;
}

// Subgroups that share a tile leave its loops each for itself.
void main() [[subgroup_uniform_control_flow]] {
    uint tile;
    uvec2 range = segment_of(tile);
    uint lane = gl_SubgroupInvocationID;
    if (range.x >= range.y) return;
    uvec2 origin = tile_origin(tile, tile_columns);
    origin.y += gl_SubgroupID * PART_HEIGHT;
    uvec2 first_pixel = origin + lane_pixel();
    vec2 first_center = vec2(first_pixel) + 0.5;

    float transmittance[GROUPS];    // below TRANSMITTANCE_MIN once the pixel is done: it only falls
    float light[GROUPS];            // still to come, times d_pixel
    float d_pixel[GROUPS][CHANNELS];
    [[unroll]] for (uint g = 0; g < GROUPS; g++) {
        uvec2 pixel = first_pixel + group_offset(g);
        bool inside = all(lessThan(pixel, size));
        uint at = inside ? pixel.y * size.x + pixel.x : 0;
        transmittance[g] = inside ? 1.0 : 0.0;
        light[g] = 0.0;
        [[unroll]] for (uint c = 0; c < CHANNELS; c++) {
            d_pixel[g][c] = d_render[c * size.x * size.y + at];
            if (shapes(c)) light[g] += render[c * size.x * size.y + at] * d_pixel[g][c];
        }
    }

    // The light still to come at the start of a further segment is what those before it left.
    if (SEGMENT != 0 && WORKGROUP_INDEX >= tile_count) {
        uint block = range.x / SEGMENT;
        [[unroll]] for (uint g = 0; g < GROUPS; g++) {
            uint pixel = g * SUBGROUP_SIZE;
            transmittance[g] = segment_states[segment_state(block, 0) + pixel];
            [[unroll]] for (uint c = 0; c < CHANNELS; c++) {
                if (shapes(c))
                    light[g] -= segment_states[segment_state(block, 1 + c) + pixel] * d_pixel[g][c];
            }
        }
    }

    uint first = range.x;
    for (; first < range.y; first += BATCH) {
        bool alive = false;
        [[unroll]] for (uint g = 0; g < GROUPS; g++) alive = alive || transmittance[g] >= TRANSMITTANCE_MIN;
        if (!tile_any(alive)) break;

        uint batch = min(BATCH, range.y - first);
        uint slot = sorted_intersections[first + min(lane, batch - 1)];
        bool is_in_batch = lane < batch;
        PreparedSplat mine = prepared_splat(gaussian_ids[slot], tile_is_shared() ? lane : slot, is_in_batch, origin);
        if (SKIPS_GROUPS && is_in_batch && mine.groups == 0) store_no_record(mine.slot);
        uint waiting = stage(mine, batch);

        uint rows = 0;  // records in shared memory whose sums are not stored
        // Tested at its end: a processor's driver runs a loop tested at its head once more, with every lane off.
        if (SKIPS_GROUPS ? waiting > 0 : true) for (uint turn = 0; true;) {
            [[unroll]] for (uint k = 0; k < SPLATS_PER_TURN; k++) {
                uint j = turn + k;
                if (SKIPS_GROUPS && k > 0 && j >= waiting) continue;
                PreparedSplat splat = splat_of_batch(mine, j);
                float record[RECORD_SPACE];
                [[unroll]] for (uint i = 0; i < RECORD_SPACE; i++) record[i] = 0.0;
                vec2 offset = splat.mean2d - first_center;
                vec3 exponents[COLUMNS];
                vec3 moments[COLUMNS];  // 1, y, yy
                [[unroll]] for (uint i = 0; i < COLUMNS; i++) {
                    exponents[i] = exponent_in_column(splat.form, splat.peak, offset.x - float(group_offset(i).x));
                    moments[i] = vec3(0.0);
                }

                float magnitudes = 0.0;
                float weights[GROUPS];
                // Choices are between names, both computed: a compiler makes branches of others.
                [[unroll]] for (uint g = 0; g < GROUPS; g++) {
                    if ((splat.groups & 1u << g) == 0) continue;
                    float y = offset.y - float(group_offset(g).y);
                    float exponent = exponent_at(exponents[g % COLUMNS], y);
                    float free_alpha = exp2(exponent);
                    float alpha = visible_alpha(exponent, splat.peak, free_alpha);
                    float weight = alpha * transmittance[g];
                    transmittance[g] = transmittance_after(transmittance[g], alpha);
                    bool is_done = transmittance[g] < TRANSMITTANCE_MIN;
                    weight = is_done ? 0.0 : weight;
                    weights[g] = weight;
                    float shade = 0.0;
                    [[unroll]] for (uint c = 0; c < CHANNELS; c++) {
                        if (!sums_colors_last()) record[RECORD_HEAD + c] += weight * d_pixel[g][c];
                        if (shapes(c)) shade += splat.color[c / 4][c % 4] * d_pixel[g][c];
                    }
                    if (!any_shapes()) continue;
                    float passed = weight * shade;
                    light[g] -= passed;
                    // At the cap alpha no longer depends on the splat.
                    bool is_held = any(bvec2(is_done, free_alpha > ALPHA_MAX));
                    float d_sigma = alpha / (1.0 - alpha) * light[g] - passed;
                    d_sigma = is_held ? 0.0 : d_sigma;
                    magnitudes += abs(d_sigma);
                    float d_sigma_y = d_sigma * y;
                    moments[g % COLUMNS] += vec3(d_sigma, d_sigma_y, d_sigma_y * y);
                }
                [[unroll]] for (uint i = 0; i < COLUMNS; i++) {
                    float x = offset.x - float(group_offset(i).x);
                    float moment_x = x * moments[i].x;
                    record[0] += moments[i].x;
                    record[1] += moment_x;
                    record[2] += moments[i].y;
                    record[3] += x * moment_x;
                    record[4] += x * moments[i].y;
                    record[5] += moments[i].z;
                }
                record[6] = magnitudes;
                [[unroll]] for (uint g = 0; g < GROUPS; g++) {
                    if (!sums_colors_last() || (splat.groups & 1u << g) == 0) continue;
                    [[unroll]] for (uint c = 0; c < CHANNELS; c++)
                        record[RECORD_HEAD + c] += weights[g] * d_pixel[g][c];
                }
                if (SUMS_IN_SHARED_MEMORY != 0) {
                    put_row(rows++, record);
                    if (rows == ROWS || j + 1 == waiting) {
                        store_row_sums(j + 1 - rows, rows);
                        rows = 0;
                    }
                } else {
                    sum_record(record);
                    [[unroll]] for (uint i = 0; i < RECORD_FLOATS; i += SUBGROUP_SIZE) {
                        if (i + lane < stored_values() && j < waiting)
                            store_sum(splat.slot, i + lane, record[i / SUBGROUP_SIZE]);
                    }
                }
            }
            turn += SPLATS_PER_TURN;
            if (turn >= waiting) break;
        }
        order_shared_memory();
        if (tile_is_shared()) {
            barrier();
            // The sums, in the order of the parts. Unrolled: some devices limit the iterations of an invocation.
            [[unroll]] for (uint k = 0; k < BATCH * RECORD_FLOATS; k += SUBGROUP_SIZE * SUBGROUPS_PER_TILE) {
                uint i = k + gl_LocalInvocationIndex;
                uint j = i / RECORD_FLOATS, value = i % RECORD_FLOATS;
                if (j < batch) {
                    float sum = 0.0;
                    [[unroll]] for (uint part = 0; part < SUBGROUPS_PER_TILE; part++)
                        sum += value < RECORD ? shares[(part * BATCH + j) * RECORD + value] : 0.0;
                    uint at = RECORD_VECTORS * sorted_intersections[first + j] + value / 4;
                    gradient_records[at][value % 4] = sum;
                }
            }
        }
    }
    // After a tile that is done every gradient is zero.
    for (uint i = first + gl_LocalInvocationIndex; i < range.y; i += SUBGROUP_SIZE * SUBGROUPS_PER_TILE) {
        uint at = RECORD_VECTORS * sorted_intersections[i];
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) gradient_records[at + k] = vec4(0.0);
    }
}
