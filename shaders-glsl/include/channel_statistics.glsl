// Mean and 1 / standard deviation of a channel.
struct ChannelStatistics {
    float mean;
    float inverse_deviation;
};
