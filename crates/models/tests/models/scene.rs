//! Gaussians on the host: their table, their initialisation.

use glam::{DAffine3, DVec2, DVec3, Quat, Vec3};
use nightsplat_core::Error;
use nightsplat_core::camera::{Camera, CameraModel};
use nightsplat_models::attributes::planes;
use nightsplat_models::gaussians::init::Initialization;
use nightsplat_models::gaussians::{
    ATTRIBUTES, Features, Gaussians, SH_C0, Shape, init, rest_coefficients, width,
};
use nightsplat_photographs::dataset::{Point, Split, View};
use nightsplat_photographs::image::Image;

/// A camera at `position` that looks along +z.
fn camera(position: DVec3) -> Camera {
    Camera {
        width: 8,
        height: 6,
        focal: DVec2::splat(10.0),
        principal_point: DVec2::new(4.0, 3.0),
        model: CameraModel::Pinhole,
        view_from_world: DAffine3::from_translation(-position),
    }
}

/// Gaussians whose parameters are all distinct.
pub(crate) fn distinct(count: usize, shape: impl Into<Shape>) -> Gaussians {
    let mut gaussians = Gaussians::zeros(count, shape);
    for (index, parameter) in gaussians.parameters.iter_mut().enumerate() {
        *parameter = (index as f32 * 0.37).sin() * 1e3 + 1e-7 * index as f32;
    }
    gaussians
}

mod table {
    use super::*;

    #[test]
    fn the_rows_are_in_the_order_of_the_planes() {
        for (index, spec) in ATTRIBUTES.iter().enumerate() {
            assert_eq!(spec.attribute as usize, index, "{}", spec.name);
        }
    }

    /// Files and shaders have depended on these columns since the first version.
    #[test]
    fn the_columns_do_not_change() {
        let columns = ATTRIBUTES.map(|spec| spec.attribute.column(2));
        assert_eq!(columns, [0, 3, 7, 10, 11, 14, 16]);
    }

    #[test]
    fn the_accessors_cover_every_parameter_once() {
        let shapes = [
            Features::NONE,
            Features { structure: true, noise: true, ..Features::NONE },
            Features::ALL,
        ]
        .into_iter()
        .flat_map(|features| (0..=3).map(move |sh_degree| Shape { sh_degree, features }));
        for shape in shapes {
            let Shape { sh_degree, features } = shape;
            let mut gaussians = Gaussians::zeros(5, shape);
            assert_eq!(
                gaussians.parameters.len(),
                5 * (14 + features.width() + 3 * ((sh_degree as usize + 1).pow(2) - 1))
            );
            gaussians.means_mut().fill(Vec3::splat(1.0));
            gaussians.quats_mut().fill([2.0; 4]);
            gaussians.log_scales_mut().fill(Vec3::splat(3.0));
            gaussians.raw_opacities_mut().fill(4.0);
            gaussians.dc_mut().fill(Vec3::splat(5.0));
            gaussians.features_mut().fill(6.0);
            gaussians.rest_mut().fill(Vec3::splat(7.0));
            let widths = planes(features.width(), width(shape)).map(|plane| 5 * plane.width);
            let expected = (1..=7).zip(widths).flat_map(|(value, len)| vec![value as f32; len]);
            assert_eq!(gaussians.parameters, expected.collect::<Vec<_>>());
            assert_eq!(
                (gaussians.means().len(), gaussians.quats().len(), gaussians.log_scales().len()),
                (5, 5, 5)
            );
            assert_eq!((gaussians.raw_opacities().len(), gaussians.dc().len()), (5, 5));
            assert_eq!(gaussians.rest().len(), 5 * rest_coefficients(sh_degree));
        }
    }
}

mod from_points {
    use super::*;

    fn scales(positions: &[DVec3]) -> Vec<f32> {
        let colors = vec![Vec3::ZERO; positions.len()];
        let gaussians =
            Gaussians::from_points(positions, &colors, 0, &Initialization::PAPER, 0).unwrap();
        gaussians.log_scales().iter().map(|log_scale| log_scale.x.exp()).collect()
    }

    #[test]
    fn every_attribute_is_initialised_as_in_3dgs() {
        let positions = [DVec3::ZERO, DVec3::X, DVec3::Y * 2.0, DVec3::Z * 3.0];
        let colors = [Vec3::new(0.1, 0.5, 0.9); 4];
        let gaussians =
            Gaussians::from_points(&positions, &colors, 2, &Initialization::PAPER, 0).unwrap();
        assert_eq!((gaussians.count, gaussians.shape), (4, 2.into()));
        assert_eq!(gaussians.means()[2], Vec3::new(0.0, 2.0, 0.0));
        assert_eq!(gaussians.quats(), [[1.0, 0.0, 0.0, 0.0]; 4]);
        let opacity = 1.0 / (1.0 + (-gaussians.raw_opacities()[3]).exp());
        assert!((opacity - 0.1).abs() < 1e-6);
        let color = gaussians.dc()[0] * SH_C0 + 0.5;
        assert!(color.abs_diff_eq(colors[0], 1e-6), "{color}");
        assert!(gaussians.rest().iter().all(|&coefficient| coefficient == Vec3::ZERO));
        // The mean squared distance from the origin is (1 + 4 + 9) / 3.
        assert!((gaussians.log_scales()[0].y.exp() - (14.0f32 / 3.0).sqrt()).abs() < 1e-6);
    }

    #[test]
    fn neighbours_in_a_plane_give_discs_in_it() {
        let normal = DVec3::new(1.0, 2.0, -2.0) / 3.0;
        let (right, up) =
            (normal.any_orthonormal_vector(), normal.cross(normal.any_orthonormal_vector()));
        let position = |i: i32| DVec3::ONE + right * f64::from(i % 9) + up * f64::from(i / 9);
        let positions: Vec<DVec3> = (0..81).map(position).collect();
        let colors = vec![Vec3::ONE; positions.len()];
        let start = Initialization { opacity: 0.3, scale: 0.5, min_axis_ratio: 0.2 };
        let gaussians = Gaussians::from_points(&positions, &colors, 0, &start, 0).unwrap();
        // In the middle of the grid, with neighbours on all sides.
        let middle = 40;
        let [w, x, y, z] = gaussians.quats()[middle];
        let scales = gaussians.log_scales()[middle].exp();
        let thin = scales.min_position();
        let axis = Quat::from_xyzw(x, y, z, w) * Vec3::AXES[thin];
        assert!(axis.as_dvec3().dot(normal).abs() > 1.0 - 1e-6, "{axis}");
        assert!((scales[thin] - 0.2 * scales.max_element()).abs() < 1e-6, "{scales}");
        // The disc has the area of an isotropic Gaussian at half the grid spacing.
        let area = scales.element_product() / scales.min_element();
        assert!((area - 0.25).abs() < 1e-6, "{scales}");
        let opacity = 1.0 / (1.0 + (-gaussians.raw_opacities()[middle]).exp());
        assert!((opacity - 0.3).abs() < 1e-6);
    }

    #[test]
    fn collinear_points_and_pairs_give_finite_gaussians() {
        for count in [2, 3, 20] {
            let positions: Vec<DVec3> = (0..count).map(|i| DVec3::X * f64::from(i)).collect();
            let colors = vec![Vec3::ONE; positions.len()];
            let start = Initialization::default();
            let gaussians = Gaussians::from_points(&positions, &colors, 0, &start, 0).unwrap();
            assert!(gaussians.parameters.iter().all(|value| value.is_finite()), "{count}");
            for quat in gaussians.quats() {
                let norm: f32 = quat.iter().map(|part| part * part).sum();
                assert!((norm - 1.0).abs() < 1e-6, "{quat:?}");
            }
        }
    }

    #[test]
    fn invalid_start_settings_are_refused_by_name() {
        for (start, name) in [
            (Initialization { opacity: 1.0, ..Initialization::PAPER }, "start.opacity"),
            (Initialization { scale: 0.0, ..Initialization::PAPER }, "start.scale"),
            (
                Initialization { min_axis_ratio: f64::NAN, ..Initialization::PAPER },
                "start.min_axis_ratio",
            ),
        ] {
            let message = Gaussians::from_points(&[], &[], 0, &start, 0).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
    }

    #[test]
    fn the_scales_equal_those_of_a_search_through_all_pairs() {
        let coordinate = |i: usize| ((i as f64 * 12.9898).sin() * 43_758.545_3).fract();
        let positions: Vec<_> = (0..500)
            .map(|i| DVec3::new(coordinate(3 * i), coordinate(3 * i + 1), coordinate(3 * i + 2)))
            .collect();
        for (position, scale) in positions.iter().zip(scales(&positions)) {
            let mut squared: Vec<f64> =
                positions.iter().map(|other| other.distance_squared(*position)).collect();
            squared.sort_by(f64::total_cmp);
            let expected = (squared[1..4].iter().sum::<f64>() / 3.0).sqrt();
            assert!((f64::from(scale) - expected).abs() < 1e-6 * expected, "{scale} {expected}");
        }
    }

    #[test]
    fn coincident_points_do_not_shrink_each_other() {
        let corners = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let doubled: Vec<_> = corners.iter().chain(&corners).copied().collect();
        assert_eq!(scales(&doubled)[..4], scales(&corners)[..]);
        assert_eq!(scales(&doubled)[4..], scales(&corners)[..]);
    }

    #[test]
    fn thousands_of_coincident_points_and_flat_grids_are_handled() {
        assert_eq!(scales(&vec![DVec3::ONE; 5000]), vec![0.01; 5000]);
        let grid: Vec<_> =
            (0..4096).map(|i| DVec3::new((i % 64) as f64, (i / 64) as f64, 0.0)).collect();
        let mut grid_twice = grid.clone();
        grid_twice.extend(&grid);
        assert!(scales(&grid_twice).iter().all(|&scale| (1.0..1.5).contains(&scale)));
    }

    #[test]
    fn fewer_than_four_positions_use_the_available_neighbours() {
        assert!(scales(&[]).is_empty());
        assert_eq!(scales(&[DVec3::ONE]), [0.01]);
        assert!(
            scales(&[DVec3::ZERO, DVec3::X * 2.0]).iter().all(|scale| (scale - 2.0).abs() < 1e-6)
        );
        let three = scales(&[DVec3::ZERO, DVec3::X, DVec3::X * 2.0]);
        assert!(
            (three[1] - 1.0).abs() < 1e-6 && (three[0] - 2.5f32.sqrt()).abs() < 1e-6,
            "{three:?}"
        );
    }

    #[test]
    fn the_closest_points_keep_a_scale_above_zero() {
        let scales = scales(&[DVec3::ZERO, DVec3::X * 1e-12, DVec3::Y * 1e-12, DVec3::Z * 1e-12]);
        assert!(scales.iter().all(|scale| (scale - 1e-7f32.sqrt()).abs() < 1e-9), "{scales:?}");
    }

    #[test]
    fn points_that_are_not_finite_or_lack_a_color_are_refused() {
        let refused = |positions: &[DVec3], colors: &[Vec3]| {
            Gaussians::from_points(positions, colors, 0, &Initialization::PAPER, 0).is_err()
        };
        assert!(refused(&[DVec3::new(0.0, f64::NAN, 0.0)], &[Vec3::ZERO]));
        assert!(refused(&[DVec3::ZERO], &[Vec3::splat(f32::INFINITY)]));
        assert!(refused(&[DVec3::ZERO, DVec3::ONE], &[Vec3::ZERO]));
    }
}

mod random {
    use super::*;

    fn sees(camera: &Camera, position: DVec3) -> bool {
        let Some(pixel) = camera.project(position) else { return false };
        // A tolerance of a hundredth of a pixel for the rounding of a position on the border.
        pixel.cmpge(DVec2::splat(-0.01)).all() && pixel.cmple(DVec2::new(8.01, 6.01)).all()
    }

    #[test]
    fn every_position_is_visible_and_most_in_two_views() {
        let cameras = [DVec3::ZERO, DVec3::X * 0.5, DVec3::Y * 0.5].map(camera);
        let positions = init::random(&cameras, 1000, 7);
        assert_eq!(positions.len(), 1000);
        let seen_by =
            |position: &DVec3| cameras.iter().filter(|camera| sees(camera, *position)).count();
        assert!(positions.iter().all(|position| seen_by(position) >= 1));
        assert!(positions.iter().filter(|position| seen_by(position) >= 2).count() > 900);
    }

    #[test]
    fn the_seed_determines_everything() {
        let cameras = [DVec3::ZERO, DVec3::X].map(camera);
        assert_eq!(init::random(&cameras, 100, 1), init::random(&cameras, 100, 1));
        assert_ne!(init::random(&cameras, 100, 1), init::random(&cameras, 100, 2));
    }

    #[test]
    fn cameras_at_one_position_see_depths_around_one() {
        let one = [camera(DVec3::splat(1e3))];
        for cameras in [&one[..], &[one[0]; 5]] {
            let depths = init::random(cameras, 200, 0).into_iter().map(|position| position.z - 1e3);
            assert!(depths.clone().all(|depth| (0.49..5.01).contains(&depth)));
            assert!(
                depths.clone().any(|depth| depth < 0.8) && depths.clone().any(|depth| depth > 2.0)
            );
        }
    }

    #[test]
    fn no_cameras_give_no_positions() {
        assert!(init::random(&[], 10, 0).is_empty());
    }
}

mod colors {
    use super::*;

    fn view(split: Split, position: DVec3) -> View {
        View::new("", split, camera(position), Some(Image::filled(8, 6, [0.0; 3])))
    }

    fn point(position: DVec3, views: &[u32]) -> Point {
        Point { position, views: views.to_vec() }
    }

    fn colors(points: &[Point], views: &[View], targets: &[Image]) -> Vec<Vec3> {
        init::colors_from_views(points, views, |_, _| 1.0, |view| Ok(targets.get(view))).unwrap()
    }

    #[test]
    fn a_color_is_the_mean_over_the_training_views_of_the_track() {
        let views = [Split::Train, Split::Train, Split::Train, Split::Test]
            .map(|split| view(split, DVec3::ZERO));
        let targets = [0.1, 0.3, 0.9, 0.9].map(|grey| Image::filled(8, 6, [grey, 0.0, 0.0]));
        let points = [point(DVec3::Z, &[0, 1, 3]), point(DVec3::Z, &[]), point(DVec3::Z, &[3])];
        let [tracked, untracked, tested] = colors(&points, &views, &targets)[..] else { panic!() };
        assert!((tracked.x - 0.2).abs() < 1e-6, "{tracked}");
        let everywhere = (0.1 + 0.3 + 0.9) / 3.0;
        assert!(
            (untracked.x - everywhere).abs() < 1e-6 && (tested.x - everywhere).abs() < 1e-6,
            "{untracked}"
        );
    }

    #[test]
    fn an_unseen_point_gets_the_mean_grey() {
        let views = [view(Split::Train, DVec3::ZERO)];
        let targets = [Image::filled(8, 6, [0.1, 0.2, 0.6])];
        for position in [DVec3::NEG_Z, DVec3::new(100.0, 0.0, 1.0), DVec3::ZERO] {
            let color = colors(&[point(position, &[0])], &views, &targets)[0];
            assert!(color.abs_diff_eq(Vec3::splat(0.3), 1e-6), "{color}");
        }
    }

    #[test]
    fn without_targets_every_point_is_grey() {
        let color = colors(&[point(DVec3::Z, &[0])], &[view(Split::Train, DVec3::ZERO)], &[])[0];
        assert_eq!(color, Vec3::splat(0.5));
    }

    #[test]
    fn sampling_is_bilinear_between_pixel_centers_and_clamps_to_the_edge() {
        let ramp = [Image::from_fn(8, 6, |x, y| [x as f32, y as f32, 1.0])];
        let views = [view(Split::Train, DVec3::ZERO)];
        let at = |x: f64, y: f64| {
            let position = DVec3::new((x - 4.0) / 10.0, (y - 3.0) / 10.0, 1.0);
            colors(&[point(position, &[0])], &views, &ramp)[0]
        };
        for (x, y) in [(2.5, 3.5), (2.75, 3.1), (4.0, 3.0), (7.5, 5.5)] {
            let expected = Vec3::new(x as f32 - 0.5, y as f32 - 0.5, 1.0);
            assert!(at(x, y).abs_diff_eq(expected, 1e-5), "{x} {y}: {}", at(x, y));
        }
        assert!(at(0.1, 5.9).abs_diff_eq(Vec3::new(0.0, 5.0, 1.0), 1e-5));
    }

    #[test]
    fn a_target_that_fails_is_reported() {
        let views = [view(Split::Train, DVec3::ZERO)];
        let failing = |_| Err::<Option<Image>, _>(Error::Usage("no target".into()));
        assert!(init::colors_from_views(&[], &views, |_, _| 1.0, failing).is_err());
    }
}
