// A model of a draw of several, as one camera sees it.
struct InstanceView {
    mat4x3 view_from_model;  // with the scale of the instance
    vec3 camera_center;      // in the model
    uint first;              // its first splat
    vec4 tint;               // factors of the colour and of the opacity
    vec3 box_min;            // means outside of the box are not seen, in the model
    vec3 box_max;
};
