//! A model on the device of Bevy's renderer: `bevy-host MODEL.ply OUT.ppm`. The plug-in has Bevy open its device with
//! what the library needs, and draws with every frame of the render world; three frames, without a window. Prints how
//! far the picture is from a device of the library's own.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bevy::app::ScheduleRunnerPlugin;
use bevy::prelude::*;
use bevy_render::renderer::raw_vulkan_init::RawVulkanInitSettings;
use bevy_render::renderer::{RenderDevice, RenderQueue};
use bevy_render::settings::{Backends, RenderCreation, WgpuSettings};
use bevy_render::{Render, RenderApp, RenderPlugin, RenderSystems};
use nightsplat::Model;
use wgpu_host::{Host, Splats, enable};

/// The frames to draw.
const FRAMES: u64 = 3;

fn main() -> std::process::ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, out] = &*arguments else {
        eprintln!("usage: bevy-host MODEL.ply OUT.ppm");
        return 2.into();
    };
    let vulkan = WgpuSettings { backends: Some(Backends::VULKAN), ..default() };
    let renderer =
        RenderPlugin { render_creation: RenderCreation::Automatic(Box::new(vulkan)), ..default() };
    let (model, out) = (model.into(), out.into());
    let exit = App::new()
        // Before the plug-in that opens the device.
        .add_plugins(SplatPlugin { model, out, drawn: Drawn::default() })
        .add_plugins(DefaultPlugins.set(renderer))
        // Without a window, frames follow each other at once.
        .add_plugins(ScheduleRunnerPlugin::run_loop(Duration::ZERO))
        .run();
    u8::from(exit != AppExit::Success).into()
}

/// Draws a model with every frame, over what a host drew before it.
struct SplatPlugin {
    model: PathBuf,
    out: PathBuf,
    drawn: Drawn,
}

/// The model's file and the picture's, in the render world.
#[derive(Resource)]
struct Files {
    model: PathBuf,
    out: PathBuf,
}

/// How many frames are drawn, in both worlds.
#[derive(Resource, Clone, Default)]
struct Drawn(Arc<AtomicU64>);

/// What draws them. It is dropped before the host.
struct Shown {
    splats: Splats,
    host: Host,
}

impl Plugin for SplatPlugin {
    fn build(&self, app: &mut App) {
        let mut settings = RawVulkanInitSettings::default();
        // SAFETY: it adds features and an extension that the library needs, and removes none. Their structs outlive the
        // call that creates the device, which ends after the callback: they stay.
        unsafe {
            settings.add_create_device_callback(|arguments, _, _| {
                enable(arguments, Box::leak(Box::default()));
            });
        }
        app.insert_resource(settings).insert_resource(self.drawn.clone()).add_systems(Update, end);
    }

    fn finish(&self, app: &mut App) {
        let Some(render_app) = app.get_sub_app_mut(RenderApp) else { return };
        let Self { model, out, drawn } = self;
        render_app
            .insert_resource(Files { model: model.clone(), out: out.clone() })
            .insert_resource(drawn.clone())
            .add_systems(Render, draw.in_set(RenderSystems::Render));
    }
}

/// A frame of the render world.
fn draw(
    device: Res<RenderDevice>,
    queue: Res<RenderQueue>,
    files: Res<Files>,
    drawn: Res<Drawn>,
    mut shown: Local<Option<Shown>>,
) -> Result {
    let number = drawn.0.load(Ordering::Relaxed) + 1;
    if number > FRAMES {
        return Ok(());
    }
    if shown.is_none() {
        let host = Host::on(device.wgpu_device().clone(), (**queue).clone()).map_err(told)?;
        let splats = Splats::new(&host, Model::load(&files.model)?).map_err(told)?;
        *shown = Some(Shown { splats, host });
    }
    if let Some(Shown { splats, host }) = &mut *shown {
        let pixels = splats.draw(host, number, None).map_err(told)?;
        if number == FRAMES {
            splats.report(&pixels, &files.out, false).map_err(told)?;
        }
    }
    drawn.0.store(number, Ordering::Relaxed);
    Ok(())
}

/// Ends the application after the last frame.
fn end(drawn: Res<Drawn>, mut exit: MessageWriter<AppExit>) {
    if drawn.0.load(Ordering::Relaxed) >= FRAMES {
        exit.write(AppExit::Success);
    }
}

/// An error that Bevy takes.
fn told(error: Box<dyn std::error::Error>) -> BevyError {
    error.to_string().into()
}
