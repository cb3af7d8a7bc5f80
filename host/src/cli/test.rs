//! `snakectl test`: scenarios that pass or fail.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use composer_shared::policy::Policy;
use composer_sim_bridge::computer::InProcess;

use super::physics::Physics;
use super::sil::Emulation;
use crate::eval::parallel;
use crate::files::write_whole;
use crate::mjcf::escaped;
use crate::policy_source::PolicySource;
use crate::robot::Robot;
use crate::scenario::{Observed, Ready, Scenario, Verdict};

/// Arguments of `test`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Scenario files, or folders of them
    #[arg(default_value = "tests/scenarios")]
    paths: Vec<PathBuf>,
    /// Run this episode alone, from 0: what a broken expectation names
    #[arg(long, value_name = "N")]
    episode: Option<usize>,
    /// Write the results as JUnit XML
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    /// Threads [default: one a core]; the result does not depend on it
    #[arg(long)]
    threads: Option<usize>,
    #[command(flatten)]
    emulation: Emulation,
}

/// A scenario file and what came of it.
struct Done {
    file: PathBuf,
    about: String,
    verdict: Result<Verdict>,
    took: Duration,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let files = files(&arguments.paths)?;
    // All are read before any runs: a mistake in the last one should not cost the others' time.
    let ready = files.iter().map(|file| Scenario::load(file)).collect::<Result<Vec<_>>>()?;
    println!("{:40} {:>8} {:>8}  broken", "scenario", "episodes", "success");
    let mut done = Vec::new();
    for (file, ready) in files.into_iter().zip(ready) {
        let start = Instant::now();
        let verdict = one(&ready, arguments);
        let one = Done { about: ready.scenario.about.clone(), verdict, took: start.elapsed(), file };
        line(&one);
        done.push(one);
    }
    if let Some(path) = &arguments.junit {
        write_whole(path, junit(&done).as_bytes())?;
        println!("written: {}", path.display());
    }
    let broken = done.iter().filter(|one| !passed(one)).count();
    if broken > 0 {
        bail!("{broken} of {} scenarios are broken", done.len());
    }
    println!("{} scenarios hold", done.len());
    Ok(())
}

/// The scenario files, in order of their names.
fn files(paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in paths {
        if path.is_dir() {
            let entries =
                std::fs::read_dir(path).with_context(|| format!("cannot read the folder {}", path.display()))?;
            let mut found = Vec::new();
            for entry in entries {
                let entry = entry.with_context(|| format!("cannot read the folder {}", path.display()))?.path();
                if entry.extension().is_some_and(|extension| extension == "toml") {
                    found.push(entry);
                }
            }
            found.sort();
            files.extend(found);
        } else {
            files.push(path.clone());
        }
    }
    if files.is_empty() {
        bail!("there are no scenarios in {}: they are files whose names end in .toml", paths[0].display());
    }
    Ok(files)
}

/// Runs one scenario.
fn one(ready: &Ready, arguments: &Arguments) -> Result<Verdict> {
    let scenario = &ready.scenario;
    let source = PolicySource::load(ready.policy())?;
    let image = source
        .image()
        .with_context(|| format!("{} is no policy image: scenarios test what is flashed", ready.policy()))?;
    let file = scenario.robot.as_deref().map(Robot::load).transpose()?;
    let robot = match scenario.modules {
        None => file,
        Some(modules) => Some(file.unwrap_or_default().with_modules(modules)?),
    };
    let physics = Physics { vary: scenario.vary.clone(), ..Physics::default() };
    let config = Arc::new(physics.apply(source.environment(None, robot.as_ref())?)?);
    ready.fits(config.robot.modules)?;
    let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let qemu = arguments.emulation.launcher(image)?;
    let local = InProcess::new(policy);
    let episode = |index: usize| match &qemu {
        Some(qemu) => ready.episode(qemu, &config, policy, index),
        None => ready.episode(&local, &config, policy, index),
    };
    let observed: Vec<Observed> = match arguments.episode {
        Some(index) => vec![episode(index)?],
        None => {
            let threads = arguments.threads.unwrap_or_else(super::cores);
            parallel(scenario.episodes, threads, episode).into_iter().collect::<Result<_>>()?
        }
    };
    let mut verdict = ready.verdict(&observed);
    if let Some(index) = arguments.episode {
        verdict.broken.iter_mut().for_each(|broken| broken.episode = broken.episode.map(|_| index));
    }
    Ok(verdict)
}

fn passed(done: &Done) -> bool {
    done.verdict.as_ref().is_ok_and(|verdict| verdict.broken.is_empty())
}

fn name(file: &Path) -> String {
    file.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// The command that shows a broken expectation again.
fn again(file: &Path, episode: Option<usize>) -> String {
    match episode {
        Some(episode) => format!("snakectl test {} --episode {episode}", file.display()),
        None => format!("snakectl test {}", file.display()),
    }
}

/// What is wrong, one line each.
fn complaints(done: &Done) -> Vec<String> {
    match &done.verdict {
        Err(error) => vec![format!("{error:#}")],
        Ok(verdict) => verdict
            .broken
            .iter()
            .map(|broken| format!("{} ({})", broken.what, again(&done.file, broken.episode)))
            .collect(),
    }
}

/// The row of the table.
fn line(done: &Done) {
    let (episodes, success) = match &done.verdict {
        Ok(verdict) => (verdict.episodes.to_string(), format!("{:.3}", verdict.success_rate)),
        Err(_) => ("-".into(), "-".into()),
    };
    println!("{:40} {episodes:>8} {success:>8}  {}", name(&done.file), if passed(done) { "-" } else { "BROKEN" });
    for complaint in complaints(done) {
        println!("    {complaint}");
    }
}

/// The results as JUnit XML, as Jenkins, GitLab and GitHub's actions read it.
fn junit(done: &[Done]) -> String {
    let failures = done.iter().filter(|one| !passed(one)).count();
    let seconds = |of: &[Done]| of.iter().map(|one| one.took.as_secs_f64()).sum::<f64>();
    let counts = format!("tests=\"{}\" failures=\"{failures}\" errors=\"0\" time=\"{:.3}\"", done.len(), seconds(done));
    let mut xml = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites name=\"snakectl test\" {counts}>\n  <testsuite name=\"scenarios\" {counts}>\n"
    );
    for one in done {
        let (name, time) = (escaped(&name(&one.file)), one.took.as_secs_f64());
        xml += &format!("    <testcase name=\"{name}\" classname=\"snakectl.test\" time=\"{time:.3}\">\n");
        let complaints = complaints(one);
        if !complaints.is_empty() {
            let message = escaped(&complaints.join("; "));
            xml += &format!("      <failure message=\"{message}\" type=\"expectation\"/>\n");
        }
        xml += &format!("      <system-out>{}</system-out>\n    </testcase>\n", escaped(&one.about));
    }
    xml + "  </testsuite>\n</testsuites>\n"
}
