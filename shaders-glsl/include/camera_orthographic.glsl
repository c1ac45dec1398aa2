// The orthographic camera: focal * (x, y) + principal point, where focal is in pixels per world unit. Rays are parallel.
// It has no gradients: no training view has this camera. Included by camera.glsl.

vec2 orthographic_project(vec3 point, Camera camera) { return camera.focal * point.xy + camera.principal_point; }

Jacobian orthographic_jacobian(Camera camera) {
    return Jacobian(camera.focal, vec3(1.0, 0.0, 0.0), vec3(0.0, 1.0, 0.0));
}
