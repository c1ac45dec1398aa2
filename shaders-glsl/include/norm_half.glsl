#include "channel_statistics.glsl"
#include "packed.glsl"

// The partition of packed maps in the norm kernels: a subgroup processes CHUNK pixels of PACKED_CHANNELS channels, and
// a lane eight of these.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint CHUNK = 128;

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint channel_count;
    uint offset;            // of the layer in `values`: the scales gamma of all channels, then the shifts beta
    uint slot;              // use of the layer times `channel_count`: the index of its statistics
    float most_normalised;  // which no magnitude of n exceeds: the root of the number of pixels, or more
};

// Lanes that share a pixel, and pixels that a subgroup processes at once.
const uint PIXEL_LANES = PACKED_CHANNELS / 8;
#define STEP (SUBGROUP_SIZE / PIXEL_LANES)

// Workgroups: (chunks, channels / PACKED_CHANNELS).
#define EIGHT (gl_WorkGroupID.y * PIXEL_LANES + gl_SubgroupInvocationID % PIXEL_LANES)
#define CHUNK_COUNT ((size.x * size.y + CHUNK - 1) / CHUNK)

// Among the pixels of a map or of a packed map, of which there are `count`: this lane's first, and one past its last.
uint chunk_begin() { return gl_WorkGroupID.x * CHUNK + gl_SubgroupInvocationID / PIXEL_LANES; }
uint chunk_end(uint count) { return min((gl_WorkGroupID.x + 1) * CHUNK, count); }

// This lane's channels of pixel `i` of a map, as an index of eights.
uint eight_of(uint i) { return packed_index(size, channel_count, uvec2(i % size.x, i / size.x)) + EIGHT; }

// The sum over the lanes with the same channels, in each of them.
float sum_of_pixels(float x) {
    [[unroll]] for (uint bit = 1; bit < 7; bit++)
        if ((1u << bit) < SUBGROUP_SIZE) x += subgroupShuffle(x, gl_SubgroupInvocationID ^ (1u << bit));
    return x;
}
