//! Errors, sorted by what the user can do about them.
//!
//! A message names a setting by its key in config.toml: `max_gaussians`, `density.depth_seeding`.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// The result of everything in this crate that can fail.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An error names the object, the problem and, if there is one, the remedy, on one line.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An input file or folder is missing, truncated or invalid.
    #[error("{}: {problem}", one_line(&path.to_string_lossy()))]
    Input {
        /// The file or folder.
        path: PathBuf,
        /// The problem and the remedy.
        problem: String,
    },
    /// A file or folder could not be written.
    #[error("{}: {problem}", one_line(&path.to_string_lossy()))]
    Output {
        /// The file or folder.
        path: PathBuf,
        /// The problem and the remedy.
        problem: String,
    },
    /// A setting has an invalid value; the exit code is 2.
    #[error("{key} is {value}; it must be {rule}")]
    Setting {
        /// Its dotted path in config.toml.
        key: String,
        /// The value.
        value: String,
        /// The values that it takes.
        rule: String,
    },
    /// A setting, an argument or a combination of them is invalid; the exit code is 2.
    #[error("{0}")]
    Usage(String),
    /// There is no Vulkan loader, or no device that matches the choice.
    #[error("{0}")]
    NoDevice(String),
    /// The device lacks a requirement of the kernels.
    #[error(
        "{device} lacks {feature}; `nightsplat doctor` lists every device and what it offers, --device picks another"
    )]
    MissingFeature {
        /// The device's name.
        device: String,
        /// The feature, extension or limit, by its Vulkan name.
        feature: String,
    },
    /// The device fails a check of the operations that the kernels depend on.
    #[error("{device} fails the self-test: {what}; {remedy}, or pick another device with --device")]
    SelfTest {
        /// The device's name, with the driver.
        device: String,
        /// The first check that failed.
        what: String,
        /// What may help.
        remedy: String,
    },
    /// The driver refuses to compile a kernel, or crashes.
    #[error(
        "{device} {problem} kernel `{kernel}`; update the driver, or pick another device with --device{remedy}"
    )]
    Kernel {
        /// The device's name, with the driver.
        device: String,
        /// Completes the sentence: "refuses (`ERROR_UNKNOWN`)".
        problem: String,
        /// The kernel with its constants.
        kernel: String,
        /// What else may help.
        remedy: String,
    },
    /// A buffer does not fit into device memory.
    #[error(
        "out of device memory: buffer `{buffer}` needs {bytes} bytes; lower max_gaussians, patch_pixels \
         or cache"
    )]
    OutOfMemory {
        /// The buffer's name.
        buffer: String,
        /// Its size in bytes.
        bytes: u64,
        /// The message of the driver or the allocator.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A buffer exceeds what one binding may hold on this device.
    #[error(
        "buffer `{buffer}` needs {bytes} bytes, {device} binds {limit} at most; lower max_gaussians or patch_pixels"
    )]
    BufferTooLarge {
        /// The buffer's name.
        buffer: String,
        /// Its size in bytes.
        bytes: u64,
        /// The device's name.
        device: String,
        /// maxStorageBufferRange, in bytes.
        limit: u64,
    },
    /// The device stopped answering.
    #[error("{device} was lost while it ran `{submission}`; lower the load or update the driver")]
    DeviceLost {
        /// The device's name.
        device: String,
        /// The label of the submission.
        submission: String,
    },
    /// A Vulkan call failed for another reason.
    #[error("{call} failed on {device}: {result}")]
    Vulkan {
        /// The Vulkan call.
        call: &'static str,
        /// The device's name, or "the Vulkan loader".
        device: String,
        /// The name of the result.
        result: String,
        /// The result: a `VkResult`.
        code: i32,
    },
    /// A loss term is NaN or infinite.
    #[error(
        "step {step}, view {view}: {what} is not finite; lower the learning rates or inspect the view's image"
    )]
    NotFinite {
        /// The training step, from 1.
        step: u64,
        /// The view's name.
        view: String,
        /// The loss term or buffer that is not finite.
        what: String,
    },
    /// More splats are on one tile than a kernel can process on this device.
    #[error(
        "{view}: {splats} splats on one tile of {tile} pixels exceed the limit of {limit} on {device}; lower \
         max_gaussians or take another device"
    )]
    TileLimit {
        /// The render, or the training step and its view.
        view: String,
        /// The most splats of one tile.
        splats: u32,
        /// Width and height of the tile in pixels.
        tile: String,
        /// The device's name.
        device: String,
        /// The most that it can process.
        limit: u32,
    },
    /// A parameter became NaN or infinite.
    #[error(
        "step {step}: number {gaussian} of {plane} is not finite; lower its learning rate, or begin with another \
         seed"
    )]
    ParameterNotFinite {
        /// The last step, from 1.
        step: u64,
        /// The attribute, by its name in the table.
        plane: String,
        /// The index of the Gaussian, or of another parameter.
        gaussian: usize,
    },
    /// A run stopped on request, with its state saved.
    #[error("{}: stopped after step {step} ({cause}), saved; go on with --resume", run.display())]
    Stopped {
        /// The run directory.
        run: PathBuf,
        /// Steps done.
        step: u64,
        /// What requested it.
        cause: Stop,
    },
    /// A batch of runs stopped on request; those under way are saved.
    #[error("{}: stopped with {done} of {all} runs done ({cause}); go on with the same command", folder.display())]
    BatchStopped {
        /// The folder of their run directories.
        folder: PathBuf,
        /// Runs that are finished.
        done: usize,
        /// Runs in all.
        all: usize,
        /// What requested it.
        cause: Stop,
    },
    /// External programs were stopped on request; what they have found is kept.
    #[error("{}: stopped at {stage} ({cause}), kept; go on with the same command", folder.display())]
    StageStopped {
        /// What is not finished.
        folder: PathBuf,
        /// What they were doing.
        stage: String,
        /// What requested it.
        cause: Stop,
    },
    /// Watched work was stopped on request ([`Watch::stop`](crate::watch::Watch::stop)), or a call that trains ends
    /// within its time.
    #[error("stopped on request while {stage}")]
    Halted {
        /// The stage of the work.
        stage: &'static str,
    },
    /// The result of a checked pass differs from its CPU reference.
    #[error(
        "the device disagrees with the CPU references: {what}; update the driver, or report this with the output of \
         `nightsplat doctor`"
    )]
    Disagrees {
        /// The first difference: pass, buffer, index, both values and the bound.
        what: String,
    },
}

impl Error {
    /// An [`Error::Input`]. The problem may quote the file: it becomes one line of limited length.
    #[doc(hidden)]
    pub fn input(path: impl AsRef<Path>, problem: impl Into<String>) -> Self {
        let problem: String = problem.into();
        Self::Input { path: path.as_ref().to_owned(), problem: in_a_line(&problem) }
    }

    /// An [`Error::Output`].
    #[doc(hidden)]
    pub fn output(path: impl AsRef<Path>, problem: impl Into<String>) -> Self {
        let problem: String = problem.into();
        Self::Output { path: path.as_ref().to_owned(), problem: in_a_line(&problem) }
    }

    /// Whether this is no failure: somebody stopped the work, which goes on when the command is repeated.
    pub fn is_stop(&self) -> bool {
        matches!(self, Self::Stopped { .. } | Self::BatchStopped { .. } | Self::StageStopped { .. })
    }

    /// The process's exit code, for schedulers: 2 for misuse, 3 for unusable data, 4 for the device and its memory,
    /// those of [`Stop`] for a run that can be resumed, 1 for everything else.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Setting { .. } | Self::Usage(_) => 2,
            Self::Input { .. } => 3,
            Self::NoDevice(_)
            | Self::MissingFeature { .. }
            | Self::SelfTest { .. }
            | Self::Kernel { .. }
            | Self::OutOfMemory { .. }
            | Self::BufferTooLarge { .. }
            | Self::DeviceLost { .. }
            | Self::Vulkan { .. }
            | Self::TileLimit { .. } => 4,
            Self::Stopped { cause, .. }
            | Self::BatchStopped { cause, .. }
            | Self::StageStopped { cause, .. } => cause.exit_code(),
            Self::Output { .. }
            | Self::Halted { .. }
            | Self::NotFinite { .. }
            | Self::ParameterNotFinite { .. }
            | Self::Disagrees { .. } => 1,
        }
    }
}

/// Escapes what [`one_line`] escapes, and truncates to a thousand characters.
pub fn in_a_line(text: &str) -> String {
    const MOST: usize = 1000;
    let line = one_line(text);
    match line.char_indices().nth(MOST) {
        Some((end, _)) => format!("{} ...", &line[..end]),
        None => line.into_owned(),
    }
}

/// A name or a message on one line: characters that act on a terminal, line breaks included, are escaped.
pub fn one_line(text: &str) -> Cow<'_, str> {
    escaped(text, acts)
}

/// Text with the characters that are meant spelled as in Rust's literals.
pub fn escaped(text: &str, is_meant: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_meant) {
        return Cow::Borrowed(text);
    }
    let spelled =
        |c: char| if is_meant(c) { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(spelled).collect())
}

/// Whether a character acts on a terminal or the lines and the order of a text: control characters, separators of lines
/// and paragraphs, and marks of bidirectional text.
pub fn acts(c: char) -> bool {
    let is_mark = matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    is_mark || c.is_control()
}

/// The reason why a run stopped before its end, with its state saved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// SIGINT, from a terminal; the exit code is 130.
    Interrupted,
    /// SIGTERM, from the system or a scheduler; the exit code is 143.
    Terminated,
    /// SIGHUP, from a terminal or connection that has gone; the exit code is 129.
    HungUp,
    /// `max_minutes` are over, or SIGXCPU came; the exit code is 75, on which schedulers repeat a job.
    TimeUp,
}

impl Stop {
    /// Every reason.
    #[doc(hidden)]
    pub const ALL: [Self; 4] = [Self::Interrupted, Self::Terminated, Self::HungUp, Self::TimeUp];

    /// Its exit code.
    pub fn exit_code(self) -> u8 {
        match self {
            Self::Interrupted => 130,
            Self::Terminated => 143,
            Self::HungUp => 129,
            Self::TimeUp => 75,
        }
    }
}

impl std::fmt::Display for Stop {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Self::Interrupted => "interrupted",
            Self::Terminated => "terminated",
            Self::HungUp => "hung up",
            Self::TimeUp => "its time was up",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quoted_text_becomes_one_line_of_limited_length() {
        let printed = |problem: &str| Error::input("file", problem).to_string();
        assert_eq!(printed("is no\nnumber"), r"file: is no\nnumber");
        let path = Error::output("a\nerror: b\u{202e}", "is full").to_string();
        assert_eq!(path, r"a\nerror: b\u{202e}: is full");
        let endless = printed(&"ö\n".repeat(5000));
        assert!(endless.chars().count() < 1020 && endless.ends_with(" ..."), "{endless}");
    }
}
