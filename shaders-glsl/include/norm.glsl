// The partition of an image in the norm kernels: a subgroup processes CHUNK values of one channel.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint CHUNK = 1024;

layout(push_constant) uniform Params {
    uint pixel_count;  // of a channel
    uint channel_count;
    uint offset;  // of the layer in `values` or `gradients`: the scales gamma of all channels, then the shifts beta
    uint slot;         // use of the layer times `channel_count`: the index of its statistics
};

#include "channel_statistics.glsl"

// Workgroups: (chunks, channels); (1, channels) if chunks are merged.
#define CHANNEL gl_WorkGroupID.y
#define CHUNK_COUNT ((pixel_count + CHUNK - 1) / CHUNK)

// Among the values of the channel: this lane's first, and one past its last.
uint chunk_begin() { return gl_WorkGroupID.x * CHUNK + gl_SubgroupInvocationID; }
uint chunk_end() { return min((gl_WorkGroupID.x + 1) * CHUNK, pixel_count); }
