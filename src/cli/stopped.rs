//! What a command tells that was stopped on request: no error, as its work is saved, but how to go on.

use super::{message, quoted};
use crate::{Error, Stop};

/// The last line of a command that did not reach its end.
pub fn ending(error: &anyhow::Error) -> String {
    match error.downcast_ref() {
        Some(Error::Stopped { step, cause, .. }) => stopped(*step, *cause),
        Some(stopped) if stopped.is_stop() => stopped.to_string(),
        _ => format!("error: {}", message(error)),
    }
}

/// How a training of this process was stopped, with the commands that go on and that finish.
pub(super) fn stopped(step: u64, cause: Stop) -> String {
    let arguments = std::env::args_os().skip(1);
    let words: Vec<String> = arguments.map(|word| word.to_string_lossy().into_owned()).collect();
    let [resume, finish] = commands(&words);
    format!(
        "stopped after step {step} ({cause}), saved; go on with `{resume}`, or finish with `{finish}`"
    )
}

/// The commands that go on with the training of a command with these arguments, and that finish it.
fn commands(arguments: &[String]) -> [String; 2] {
    const OF_ONCE: [&str; 3] = ["--overwrite", "--resume", "--finish"];
    let words = arguments.iter().filter(|word| !OF_ONCE.contains(&word.as_str()));
    let base = words.fold("nightsplat".to_owned(), |line, word| format!("{line} {}", quoted(word)));
    let command = arguments.iter().find(|word| !word.starts_with('-'));
    // Others resume unasked.
    let resume = if command.is_some_and(|name| name == "train") { " --resume" } else { "" };
    [format!("{base}{resume}"), format!("{base}{resume} --finish")]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stopped_command_is_repeated_as_it_was() {
        let told = |line: &str| commands(&line.split(' ').map(str::to_owned).collect::<Vec<_>>());
        let resume = "nightsplat train photos --out 'it'\\''s' --resume".to_owned();
        let finish = format!("{resume} --finish");
        for line in ["train photos --overwrite --out it's", "train photos --resume --out it's"] {
            assert_eq!(told(line), [resume.clone(), finish.clone()]);
        }
        let make = ["nightsplat -v photos", "nightsplat -v photos --finish"].map(str::to_owned);
        assert_eq!(told("-v photos --overwrite"), make);
    }

    #[test]
    fn only_what_failed_is_an_error() {
        let run = std::path::PathBuf::from("run");
        let stopped = Error::Stopped { run: run.clone(), step: 468, cause: Stop::Interrupted };
        let line = ending(&stopped.into());
        assert!(line.starts_with("stopped after step 468 (interrupted), saved; go on"), "{line}");
        let cause = Stop::Terminated;
        let stopped = Error::BatchStopped { folder: run.clone(), done: 1, all: 3, cause };
        let line = "run: stopped with 1 of 3 runs done (terminated); go on with the same command";
        assert_eq!(ending(&stopped.into()), line);
        assert_eq!(ending(&Error::input(run, "is a run").into()), "error: run: is a run");
    }
}
