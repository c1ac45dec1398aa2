// How a subgroup of a GPU blurs an image: a strip of as many columns as lanes, down some rows, by the window of
// include/ssim_window.glsl.
//
// A row of the strip and of RADIUS columns on either side is in shared memory; a lane blurs its own column along x and
// adds the result, weighted by the taps along y, to the rows in reach. Rows are in two places in turn, so that one
// barrier per row suffices.
//
// The includer has SUBGROUP_SIZE and the parameters `width`, `height` and `rows`.

const uint ROW = SUBGROUP_SIZE + 2 * RADIUS;  // values of a row in shared memory
const uint LOADS = (ROW + SUBGROUP_SIZE - 1) / SUBGROUP_SIZE;  // of a lane for a row

// The columns and rows of a subgroup.
struct Strip {
    uint x;        // the first column
    int y;         // the first row
    int end;       // one past the last
    uint channel;  // may be past the last: nothing to do
};

Strip strip_of(uint workgroup) {
    uint across = (width + SUBGROUP_SIZE - 1) / SUBGROUP_SIZE;
    uint down = (height + rows - 1) / rows;
    uint y = workgroup / across;
    uint top = y % down * rows;
    return Strip(workgroup % across * SUBGROUP_SIZE, int(top), int(min(top + rows, height)), y / down);
}

// Whether a place of row `y` of the strip is in the image, and its index in the image.
bool is_in_image(Strip strip, uint column, int y) {
    return strip.x + column - RADIUS < width && uint(y) < height;
}
uint index_of(Strip strip, uint column, int y) {
    return (strip.channel * height + uint(y)) * width + strip.x + column - RADIUS;
}

// Orders the subgroup's accesses to shared memory.
void share_rows() {
    controlBarrier(gl_ScopeSubgroup, gl_ScopeSubgroup, gl_StorageSemanticsShared, gl_SemanticsAcquireRelease);
}
