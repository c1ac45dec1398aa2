// What moves with one transform: the world, or an instance.
struct MovingPoints {
    mat4x3 before_from_now;  // from the view of this frame to that of the frame before
    uint   first;            // its first splat; nothing else moves so from there to the next
};
