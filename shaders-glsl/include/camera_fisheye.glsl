// The fisheye of Kannala and Brandt (2006) with four coefficients, OPENCV_FISHEYE in OpenCV and COLMAP: a point at the
// angle t off the axis is projected to t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths from the principal
// point. Included by camera.glsl.
//
// A point is seen if it is in front of the camera and its angle is below the camera's largest, up to which the
// polynomial increases: points farther off the axis would be seen twice. Depth is the distance, since z means little at
// 80 degrees.
//
// With n the unit vector perpendicular to the axis towards the point, r the polynomial, r' its derivative with respect
// to the angle, and d the distance, the derivative of the pixel is focal / d times (r / sin t) (I - n n^T) + r' cos t n
// n^T   with respect to x and y, and   -r' sin t n   with respect to z.

struct FisheyeRay {
    float distance;
    vec2  across;     // n
    float sine;       // of the angle
    float cosine;
    float radius;     // r
    float slope;      // r'
    float bend;       // r''
    float stretch;    // r / sin t
    float d_stretch;  // its derivative with respect to the angle
};

// The angle off the axis of a point at the distance r from it and z in front of the camera, both not negative: within
// three units in the last place (polynomial of Cephes' atanf), whereas Vulkan allows 4096 for atan.
float angle_off_axis(float r, float z) {
    float base = 0.0, x = r / z;
    if (r > 2.414213562373095 * z) {
        base = 1.5707963267948966;
        x = -z / r;
    } else if (r > 0.4142135623730950 * z) {
        base = 0.7853981633974483;
        x = (r - z) / (r + z);
    }
    float x2 = x * x;
    float series = ((8.05374449538e-2 * x2 - 1.38776856032e-1) * x2 + 1.99777106478e-1) * x2 - 3.33329491539e-1;
    return base + (series * x2 * x + x);
}

float fisheye_depth(vec3 point, Camera camera) {
    // Written so that a NaN is not seen; for no z below 0 is the angle known to be right.
    bool is_seen = point.z > 0.0 && angle_off_axis(length(point.xy), point.z) < camera.largest_angle;
    return is_seen ? length(point) : -1.0;
}

FisheyeRay fisheye_ray(vec3 point, Camera camera) {
    FisheyeRay ray;
    float off_axis = length(point.xy);
    ray.distance = length(point);
    ray.across = off_axis > 0.0 ? point.xy / off_axis : vec2(1.0, 0.0);
    ray.sine = off_axis / ray.distance;
    ray.cosine = point.z / ray.distance;
    vec4 k = camera.distortion;
    float t = angle_off_axis(off_axis, point.z), t2 = t * t;
    float factor = 1.0 + t2 * (k.x + t2 * (k.y + t2 * (k.z + t2 * k.w)));
    float d_factor = t * (2.0 * k.x + t2 * (4.0 * k.y + t2 * (6.0 * k.z + t2 * 8.0 * k.w)));
    ray.radius = t * factor;
    ray.slope = 1.0 + t2 * (3.0 * k.x + t2 * (5.0 * k.y + t2 * (7.0 * k.z + t2 * 9.0 * k.w)));
    ray.bend = t * (6.0 * k.x + t2 * (20.0 * k.y + t2 * (42.0 * k.z + t2 * 72.0 * k.w)));
    // t / sin t and its derivative, whose terms cancel near the axis.
    float ratio = ray.sine > 0.0 ? t / ray.sine : 1.0;
    float series = t * (1.0 / 3.0 + t2 * (7.0 / 90.0 + t2 * (31.0 / 2520.0 + t2 * (127.0 / 75600.0))));
    float d_ratio = t < 0.5 ? series : (ray.sine - t * ray.cosine) / (ray.sine * ray.sine);
    ray.stretch = factor * ratio;
    ray.d_stretch = d_factor * ratio + factor * d_ratio;
    return ray;
}

vec2 fisheye_project(vec3 point, Camera camera) {
    FisheyeRay ray = fisheye_ray(point, camera);
    return camera.focal * (ray.radius * ray.across) + camera.principal_point;
}

Jacobian fisheye_jacobian(vec3 point, Camera camera) {
    FisheyeRay ray = fisheye_ray(point, camera);
    vec2 n = ray.across;
    float along = ray.slope * ray.cosine - ray.stretch;
    float forward = ray.slope * ray.sine;
    vec3 row0 = vec3(ray.stretch + along * n.x * n.x, along * n.x * n.y, -forward * n.x);
    vec3 row1 = vec3(along * n.x * n.y, ray.stretch + along * n.y * n.y, -forward * n.y);
    return Jacobian(camera.focal / ray.distance, row0, row1);
}

// With respect to distance, angle and azimuth: derivatives of d_pixel . pixel and (S / d) with S = r / sin t ss + r'
// cos t nn - r' sin t zn, where nn, ss and zn are components of the rows' gradient along and across n.
vec3 fisheye_backward(vec3 point, Camera camera, vec2 d_pixel, vec3 d_row0, vec3 d_row1) {
    FisheyeRay ray = fisheye_ray(point, camera);
    vec2 n = ray.across, side = vec2(-n.y, n.x);
    vec2 d_place = camera.focal * d_pixel;
    vec3 along_n = n.x * camera.focal.x * d_row0 + n.y * camera.focal.y * d_row1;
    vec3 along_side = side.x * camera.focal.x * d_row0 + side.y * camera.focal.y * d_row1;
    float nn = dot(along_n.xy, n), ss = dot(along_side.xy, side);
    float mixed = dot(along_n.xy, side) + dot(along_side.xy, n);
    float zn = along_n.z, zs = along_side.z;

    float by_distance = -(ray.stretch * ss + ray.slope * (ray.cosine * nn - ray.sine * zn));
    float by_angle = ray.d_stretch * ss + (ray.bend * ray.cosine - ray.slope * ray.sine) * nn
        - (ray.bend * ray.sine + ray.slope * ray.cosine) * zn + ray.distance * ray.slope * dot(d_place, n);
    // Divided by sin t: (r' cos t - r / sin t) / sin t is cos t times the derivative of r / sin t, minus r.
    float by_turn = (ray.d_stretch * ray.cosine - ray.stretch * ray.sine) * mixed - ray.slope * zs
        + ray.distance * ray.stretch * dot(d_place, side);
    vec2 d_xy = (by_distance * ray.sine + by_angle * ray.cosine) * n + by_turn * side;
    float d_z = by_distance * ray.cosine - by_angle * ray.sine;
    return vec3(d_xy, d_z) / ray.distance / ray.distance;
}

float fisheye_depth_change(vec3 point, vec3 offset) { return dot(point, offset) / length(point); }

vec3 fisheye_at_depth(vec3 point, float depth) { return point * (depth / length(point)); }
