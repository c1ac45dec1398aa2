use glam::UVec2;

use super::normals::{dot, pixel_ray};
use super::rounding::{Rounded, bounds_from, write};
use crate::gpu::Reference;
use crate::kernels::normals_backward::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of every pixel's mean depth, over alpha.
fn d_depths(params: &Params, slices: &Slices<'_>) -> Vec<Rounded> {
    let Params { size, focal, principal_point, scale, .. } = *params;
    let (width, zero) = (size.x as usize, Rounded::default());
    let differences = |pixel: usize, which: usize| {
        [0, 1, 2].map(|c| Rounded::exact(slices.d_differences[8 * pixel + 4 * which + c]))
    };
    let of_pixel = |i: usize| {
        let pixel = UVec2::new(i as u32 % size.x, i as u32 / size.x);
        let mut d = [zero; 3];
        let mut add = |is_there: bool, sign: f64, at: usize, which: usize| {
            if is_there {
                let by = differences(at, which);
                d = [0, 1, 2].map(|c| if sign > 0.0 { d[c] + by[c] } else { d[c] - by[c] });
            }
        };
        add(pixel.x > 0, 1.0, i.wrapping_sub(1), 0);
        add(pixel.x + 1 < size.x, -1.0, i + 1, 0);
        add(pixel.y > 0, 1.0, i.wrapping_sub(width), 1);
        add(pixel.y + 1 < size.y, -1.0, i + width, 1);
        let d_depth = Rounded::exact(scale) * dot(pixel_ray(pixel, focal, principal_point), d);
        if d_depth.value == 0.0 {
            return d_depth;
        }
        d_depth / (Rounded::exact(1.0) - Rounded::exact(slices.transmittances[i]))
    };
    (0..size.element_product() as usize).map(of_pixel).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let gradients = d_depths(params, &slices);
        write(gradients, &mut slices.d_render[params.first as usize..]);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { d_render: bounds_from(params.first as usize, d_depths(params, &slices)) }
    }
}
