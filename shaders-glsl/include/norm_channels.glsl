// n = (z - mean) / deviation and y = gamma n + beta of a lane's channels.

layout(binding = 0) readonly buffer Values      { float values[]; };
layout(binding = 1) readonly buffer Statistics  { ChannelStatistics statistics[]; };
layout(binding = 2) readonly buffer SourceBound { uint source_bound[]; };
layout(binding = 3) readonly buffer Source      { uvec4 source[]; };  // z, packed

// Zeros beyond the last channel.
float gamma[8], beta[8], mean[8], inverse_deviation[8];

void load_channels() {
    [[unroll]] for (uint c = 0; c < 8; ++c) {
        uint channel = 8 * EIGHT + c;
        bool is_channel = channel < channel_count;
        gamma[c] = is_channel ? values[offset + channel] : 0.0;
        beta[c] = is_channel ? values[offset + channel_count + channel] : 0.0;
        mean[c] = is_channel ? statistics[slot + channel].mean : 0.0;
        inverse_deviation[c] = is_channel ? statistics[slot + channel].inverse_deviation : 0.0;
    }
}

// z of eight channels, as n.
float[8] normalised(uint eight) {
    float z[8] = unpacked_eight(source[eight], packed_inverse(packed_exponent(source_bound[0])));
    [[unroll]] for (uint c = 0; c < 8; ++c) z[c] = (z[c] - mean[c]) * inverse_deviation[c];
    return z;
}
