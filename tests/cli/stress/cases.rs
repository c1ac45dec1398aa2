//! The table of hostile inputs.

use nightsplat::Result;

use super::hostile::{Hostile, camera_of_focal};
use crate::common::prelude::*;

/// An input and its expected outcome.
#[derive(Debug)]
pub(super) struct Case {
    /// The input.
    pub(super) name: &'static str,
    /// Expected outcome in words.
    pub(super) outcome: &'static str,
    /// Its cost.
    pub(super) effort: Effort,
    pub(super) expect: Expect,
    pub(super) build: fn(&Gpu) -> Result<Hostile>,
}

/// The cost of a case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Effort {
    /// Seconds; run by the tests.
    Quick,
    /// Seconds.
    Small,
    /// Seconds to minutes: the references process every pixel and splat.
    Large,
    /// As large as the device allows, which is too much for the references.
    Unchecked,
}

/// Expected outcome of a case. In every case, loss, gradients and parameters are finite.
#[derive(Clone, Copy, Debug)]
pub(super) enum Expect {
    /// The hostile Gaussians learn.
    Learns,
    /// They have no gradient and do not change.
    NoTrace,
    /// The steps are done.
    Trains,
    /// An error that contains this.
    Refusal(&'static str),
}

const SIZE: [u32; 2] = [32, 24];

fn scales(log: [f64; 3]) -> Result<Hostile> {
    let log = Vec3::from_array(log.map(|power| (power * std::f64::consts::LN_10) as f32));
    Ok(Hostile::gaussians(1, SIZE, |gaussians, i| gaussians.log_scales_mut()[i] = log))
}

fn opacity(raw: f32) -> Result<Hostile> {
    Ok(Hostile::gaussians(1, SIZE, |gaussians, i| gaussians.raw_opacities_mut()[i] = raw))
}

fn quat(quat: [f32; 4]) -> Result<Hostile> {
    Ok(Hostile::gaussians(1, SIZE, |gaussians, i| gaussians.quats_mut()[i] = quat))
}

fn mean(x: f32, y: f32, z: f32) -> Result<Hostile> {
    Ok(Hostile::gaussians(1, SIZE, |gaussians, i| gaussians.means_mut()[i] = Vec3::new(x, y, z)))
}

/// Trains one step, in which Adam moves the Gaussian out of the view.
fn at_once(mut hostile: Hostile) -> Hostile {
    hostile.config.steps = 1;
    hostile
}

/// Every hostile Gaussian of the table in front of one camera.
fn all_at_once() -> Result<Hostile> {
    let log = |power: f32| power * std::f32::consts::LN_10;
    Ok(Hostile::gaussians(24, SIZE, |gaussians, i| {
        // At different depths, so that their order does not depend on rounding.
        gaussians.means_mut()[i].z = 3.0 + 0.1 * i as f32;
        match i {
            0..4 => gaussians.log_scales_mut()[i] = Vec3::splat(log([-20.0, 3.0, 10.0, 20.0][i])),
            4 => gaussians.log_scales_mut()[i] = Vec3::new(log(-20.0), 0.0, log(20.0)),
            5..10 => gaussians.raw_opacities_mut()[i] = [-100.0, -20.0, -5.5, 20.0, 100.0][i - 5],
            10..16 => {
                let size = [0.0, 1e-40, 1e-10, 1e15, 1e30, 1e38][i - 10];
                gaussians.quats_mut()[i] = [1.0, 2.0, -1.0, 0.3].map(|k| k * size);
            }
            16..23 => {
                gaussians.means_mut()[i] = [
                    Vec3::new(0.0, 0.0, 0.2),
                    Vec3::new(0.1, 0.1, -3.0),
                    Vec3::ZERO,
                    Vec3::splat(1e-7),
                    Vec3::new(1e5, 1e5, 1e7),
                    Vec3::new(1e7, 0.0, 3.0),
                    Vec3::new(1e28, 1e28, 1e30),
                ][i - 16];
            }
            _ => gaussians.dc_mut()[i] = Vec3::splat(1e6),
        }
    }))
}

/// Many Gaussians at one position, identical or with different colours and opacities.
fn coincident(count: usize) -> Result<Hostile> {
    let stream = Stream::new(14, 1);
    Ok(Hostile::gaussians(count, SIZE, |gaussians, i| {
        gaussians.quats_mut()[i] = [1.0, 0.2, 0.1, 0.0];
        gaussians.raw_opacities_mut()[i] = -4.0;
        gaussians.dc_mut()[i].x = stream.normal(i as u64) as f32;
    }))
}

/// Many faint Gaussians on one pixel of an image of one tile, in a row along the axis.
fn splats_per_tile(count: usize) -> Result<Hostile> {
    let mut hostile = Hostile::gaussians(count, [16, 8], |gaussians, i| {
        let depth = 1.0 + 4.0 * i as f32 / 100_000.0;
        gaussians.means_mut()[i] = Vec3::new(0.0, 0.0, depth);
        gaussians.log_scales_mut()[i] = Vec3::splat((0.1 * depth / 14.4).ln());
        gaussians.raw_opacities_mut()[i] = -4.5;
    });
    hostile.config.steps = 1;
    Ok(hostile)
}

fn focal(focal: f64) -> Result<Hostile> {
    Ok(Hostile::seen_by(camera_of_focal(focal, SIZE), 1, |gaussians, i| {
        gaussians.means_mut()[i] = Vec3::new(0.0, 0.0, 3.0);
    }))
}

fn size(width: u32, height: u32) -> Result<Hostile> {
    Ok(Hostile::gaussians(1, [width, height], |_, _| ()))
}

/// One that covers a view of more than ten thousand tiles.
fn wide() -> Result<Hostile> {
    let mut hostile = Hostile::gaussians(1, [1920, 1080], |gaussians, i| {
        gaussians.log_scales_mut()[i] = Vec3::splat(3.0);
    });
    hostile.config.steps = 1;
    Ok(hostile)
}

/// A square view of 8192 pixels, or the largest that the device can train on.
fn largest(gpu: &Gpu) -> Result<Hostile> {
    let settings = RenderSettings::default();
    let fits = |side: u32| settings.check_size(gpu, "of stress", [side; 2]).is_ok();
    let (mut low, mut high) = (16, 8193);
    while high - low > 1 {
        let middle = (low + high) / 2;
        *(if fits(middle) { &mut low } else { &mut high }) = middle;
    }
    let mut hostile = Hostile::gaussians(1, [low; 2], |_, _| ());
    hostile.config.steps = 1;
    hostile.config.tile = Some(settings.tile_for(gpu, std::iter::once([low; 2]))?);
    Ok(hostile)
}

/// A refusal, or else the step is done.
fn beyond(gpu: &Gpu) -> Result<Hostile> {
    RenderSettings::default().check_size(gpu, "of stress", [65_535; 2])?;
    size(16, 16)
}

fn sh(dc: f32, rest: f32) -> Result<Hostile> {
    let stream = Stream::new(14, 2);
    Ok(Hostile::gaussians(1, SIZE, |gaussians, i| {
        if dc > 0.0 {
            gaussians.dc_mut()[i] = Vec3::splat(dc);
        }
        for (k, coefficient) in (0..15).zip(gaussians.rest_mut()) {
            let draw = |c: u64| rest * stream.normal(3 * k + c) as f32;
            *coefficient = Vec3::from_array([0, 1, 2].map(draw));
        }
    }))
}

/// No Gaussian at all.
fn none() -> Hostile {
    let gaussians = Some(Gaussians::zeros(0, 3));
    Hostile { gaussians, concerned: 0..0, ..Hostile::gaussians(1, SIZE, |_, _| ()) }
}

fn photograph(grey: impl Fn(u32, u32) -> f32) -> Result<Hostile> {
    Ok(Hostile::photograph(|x, y| [grey(x, y); 3]))
}

fn black_by_auto() -> Result<Hostile> {
    let mut hostile = photograph(|_, _| 0.0)?;
    hostile.config.tone = ToneSettings::default();
    Ok(hostile)
}

fn gain(gain: f32) -> Result<Hostile> {
    Hostile::gaussians(1, SIZE, |_, _| ()).exposed(gain)
}

use Expect::{Learns, NoTrace, Refusal, Trains};

/// A row: the effort, the input, its outcome in words and in a checkable form, and what builds it.
macro_rules! cases {
    ($($effort:ident $name:literal: $outcome:literal, $expect:expr, $build:expr;)*) => {
        &[$(Case { name: $name, outcome: $outcome, effort: Effort::$effort, expect: $expect, build: $build }),*]
    };
}

/// Every input.
pub(super) const CASES: &[Case] = cases! {
    Small "scales 1e-20": "a dot as wide as the dilation; Adam raises them to e^-30", Trains, |_| scales([-20.0; 3]);
    Small "scales 1e-20, 1, 1e-20": "a needle as wide as the dilation", Learns, |_| scales([-20.0, 0.0, -20.0]);
    Small "scales 1e3": "covers the view", Learns, |_| scales([3.0; 3]);
    Small "scales 1e10": "culled, then lowered by Adam to e^13, which covers the view", Trains, |_| scales([10.0; 3]);
    Small "scales 1e20": "culled, then lowered by Adam to e^13, which covers the view", Trains, |_| scales([20.0; 3]);
    Quick "scales 1e-20, 1, 1e20": "culled, then lowered by Adam to e^13", Trains, |_| scales([-20.0, 0.0, 20.0]);
    Small "raw opacity -100": "culled: no trace", NoTrace, |_| opacity(-100.0);
    Small "raw opacity -20": "culled: no trace", NoTrace, |_| opacity(-20.0);
    Small "raw opacity -5.5": "just above 1/255: learns", Learns, |_| opacity(-5.5);
    Quick "raw opacity 20": "opaque; learns", Learns, |_| opacity(20.0);
    Small "raw opacity 100": "opaque; learns but for its opacity", Learns, |_| opacity(100.0);
    Small "quaternion 0": "unturned, and no gradient turns it", Learns, |_| quat([0.0; 4]);
    Small "quaternion 1e-40": "unturned, and no gradient turns it", Learns, |_| quat([1e-40, 2e-40, -1e-40, 0.0]);
    Small "quaternion 1e-10": "as of unit length", Learns, |_| quat([1e-10, 2e-10, -1e-10, 3e-11]);
    Small "quaternion 1e15": "as of unit length", Learns, |_| quat([1e15, 2e15, -1e15, 3e14]);
    Quick "quaternion 1e30": "as of unit length", Learns, |_| quat([1e30, 2e30, -1e30, 3e29]);
    Small "quaternion 1e38": "as of unit length", Learns, |_| quat([1e38, 2e38, -1e38, 3e37]);
    Small "mean on the near plane": "culled: no trace", NoTrace, |_| mean(0.0, 0.0, 0.2);
    Small "mean 1e-6 beyond the near plane": "seen", Learns, |_| mean(0.01, 0.0, 0.200_001).map(at_once);
    Small "mean behind the camera": "culled: no trace", NoTrace, |_| mean(0.1, 0.1, -3.0);
    Small "mean in the camera": "culled: no trace", NoTrace, |_| mean(0.0, 0.0, 0.0);
    Small "mean 1e-7 away": "culled: no trace", NoTrace, |_| mean(1e-8, 1e-8, 1e-7);
    Small "mean 1e7 away": "a dot as wide as the dilation", Learns, |_| mean(1e5, 1e5, 1e7);
    Small "mean 1e7 beside": "outside of the view: no trace", NoTrace, |_| mean(1e7, 0.0, 3.0);
    Quick "mean 1e30 away": "a dot as wide as the dilation", Learns, |_| mean(1e28, 1e28, 1e30);
    Small "mean 1e38 beside": "culled: no trace", NoTrace, |_| mean(1e38, 0.0, 3.0);
    Small "all of these at once": "as each by itself", Learns, |_| all_at_once();
    Small "500 coincident": "blended in the order of their numbers", Learns, |_| coincident(500);
    Large "5000 coincident": "blended in the order of their numbers", Learns, |_| coincident(5000);
    Large "one over 16 000 tiles": "covers the view", Learns, |_| wide();
    Small "2000 on one pixel": "blended; those after a saturated pixel have no gradient", Learns,
        |_| splats_per_tile(2000);
    Large "100 000 on one pixel": "blended; those after a saturated pixel have no gradient", Learns,
        |_| splats_per_tile(100_000);
    Quick "no Gaussian": "black", Trains, |_| Ok(none());
    Small "one Gaussian": "learns", Learns, |_| Ok(Hostile::alone(SIZE));
    Small "focal length 1": "seen", Learns, |_| focal(1.0);
    Small "focal length 1e3": "seen", Learns, |_| focal(1e3);
    Small "focal length 1e6": "seen", Learns, |_| focal(1e6).map(at_once);
    Small "view 1x1": "learns", Learns, |_| size(1, 1);
    Quick "view 1x64": "learns", Learns, |_| size(1, 64);
    Small "view 64x1": "learns", Learns, |_| size(64, 1);
    Unchecked "the largest square view, to 8192": "learns", Learns, largest;
    Small "view 65535x65535": "refused, with the longest side that the device takes", Refusal("max_resolution"), beyond;
    Small "SH coefficients 1e6 of degree 0": "learns", Learns, |_| sh(1e6, 0.0);
    Small "SH coefficients 1e6 above degree 0": "learns", Learns, |_| sh(0.0, 1e6);
    Small "exposure gain 1e-6": "learns", Trains, |_| gain(1e-6);
    Quick "exposure gain 1e6": "learns", Trains, |_| gain(1e6);
    Quick "photograph black: p90 = 0": "trains towards a target of black", Trains, |_| photograph(|_, _| 0.0);
    Small "photograph black, curve auto": "refused: all black", Refusal("almost black"), |_| black_by_auto();
    Small "photograph of one value: p10 = p90": "trains", Trains, |_| photograph(|_, _| 0.05);
    Small "photograph white": "trains", Trains, |_| photograph(|_, _| 1.0);
    Small "photograph black but for one pixel": "trains", Trains,
        |_| photograph(|x, y| f32::from(u8::from(x == 5 && y == 7)));
    Small "EXR scaled by 1e-6": "trains", Trains, |_| Hostile::exr(|value, _, _| 1e-6 * value);
    Small "EXR scaled by 1e6": "trains", Trains, |_| Hostile::exr(|value, _, _| 1e6 * value);
    Small "EXR of denormals": "trains as black", Trains, |_| Hostile::exr(|value, _, _| 1e-40 * value);
    Small "EXR with NaN": "their pixels do not count, and a warning counts them", Trains,
        |_| Hostile::exr(|value, x, y| if (x + y) % 5 == 0 { f32::NAN } else { value });
    Quick "EXR with infinity and below 0":
        "infinite ones do not count, negative ones are black, and a warning counts them", Trains,
        |_| Hostile::exr(|value, x, y| match (x + y) % 5 {
            0 => f32::INFINITY,
            1 => f32::NEG_INFINITY,
            2 => -value,
            _ => value,
        });
    Small "EXR with 1e38": "trains", Trains,
        |_| Hostile::exr(|value, x, y| if (x + y) % 5 == 0 { 1e38 } else { value });
    Small "EXR of NaN": "refused: no pixel is a number", Refusal("no photograph is left to train on"),
        |_| Hostile::exr(|_, _, _| f32::NAN);
};
