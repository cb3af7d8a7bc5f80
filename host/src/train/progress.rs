//! The progress bar, or a plain line now and then where there is no terminal.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::methods::Times;

/// How often a plain line is printed.
const EVERY: Duration = Duration::from_secs(10);
/// The same for one of several runs.
const EVERY_OF_SEVERAL: Duration = Duration::from_secs(30);

/// Shows how a run is getting on, on standard error.
#[derive(Debug)]
pub struct Progress {
    bar: Option<ProgressBar>,
    /// Words before each plain line.
    name: String,
    every: Duration,
    total: u64,
    last: Instant,
    since: Times,
}

impl Progress {
    /// For a run of `total` steps, of which `done` are done. A run with a `name` is one of several at a time: they print lines with
    /// their names, as their bars would overwrite each other.
    pub fn new(total: u64, done: u64, name: Option<&str>) -> Self {
        let bar = (name.is_none() && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(total).with_position(done).with_elapsed(Duration::ZERO);
            if let Ok(style) =
                ProgressStyle::with_template("{bar:30} {human_pos}/{human_len} steps, {eta} left | {msg}")
            {
                bar.set_style(style);
            }
            bar.reset_eta();
            bar
        });
        let every = if name.is_some() { EVERY_OF_SEVERAL } else { EVERY };
        let name = name.map(|name| format!("{name}: ")).unwrap_or_default();
        Self { bar, name, every, total, last: Instant::now(), since: Times::default() }
    }

    /// After an iteration: `done` steps in all, its times, and the numbers worth watching.
    pub fn update(&mut self, done: u64, times: &Times, numbers: &[(&str, f64)]) {
        self.since.add(times);
        let due = self.last.elapsed() >= self.every;
        if self.bar.is_none() && !due {
            return;
        }
        let [physics, inference, update] = self.since.shares().map(|share| (100.0 * share).round());
        let mut message = format!(
            "{:.0} steps/s (physics {physics:.0} %, inference {inference:.0} %, update {update:.0} %)",
            self.since.steps_per_second()
        );
        for (name, value) in numbers {
            if value.is_finite() {
                message += &format!(", {name} {value:.3}");
            }
        }
        match &self.bar {
            Some(bar) => {
                bar.set_position(done);
                bar.set_message(message);
            }
            None => eprintln!("{}{done} of {} steps, {message}", self.name, self.total),
        }
        if due {
            self.last = Instant::now();
            self.since = Times::default();
        }
    }

    /// Prints a line above the bar.
    pub fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.println(line),
            None => eprintln!("{}{line}", self.name),
        }
    }

    /// Leaves the bar as it is.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.abandon();
        }
    }
}
