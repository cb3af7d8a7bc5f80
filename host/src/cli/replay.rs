//! `snakectl replay`: one module of a capture, run again on what it was told then.

use std::fs::File;
use std::io::BufReader;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use composer_shared::policy::Policy;
use composer_sim_bridge::candump::Log;
use composer_sim_bridge::computer::InProcess;
use composer_sim_bridge::replay::{self, Verdict};

use super::sil::{Emulation, transcript_of};
use crate::policy_source::PolicySource;

/// Arguments of `replay`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// A candump log that `snakectl sil --capture CAPTURE --replayable` wrote; what the modules were told lies beside it, as CAPTURE.modules
    capture: PathBuf,
    /// The module, by its number on the bus
    #[arg(long, value_name = "N")]
    node: u8,
    /// A policy image or the name of a shipped policy, another than the one of then [default: that one]
    #[arg(long)]
    policy: Option<String>,
    /// Print one JSON object and nothing else
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    emulation: Emulation,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let path = &arguments.capture;
    let text = std::fs::read(path).with_context(|| format!("cannot read the capture {}", path.display()))?;
    let text = String::from_utf8_lossy(&text);
    let log = Log::parse(&text).map_err(|(line, error)| anyhow::anyhow!("{}, line {line}: {error}", path.display()))?;
    if let Some(line) = log.cut {
        eprintln!("note: {} is cut off in the middle of line {line}, which is left out", path.display());
    }
    let beside = transcript_of(path);
    let transcript = File::open(&beside).with_context(|| {
        format!(
            "cannot read {}, which `snakectl sil --capture FILE --replayable` writes beside the log",
            beside.display()
        )
    })?;
    let mut transcript = BufReader::new(transcript);
    let heading = replay::heading(&mut transcript).with_context(|| beside.display().to_string())?;
    let name = arguments.policy.as_ref().unwrap_or(&heading.policy);
    let source = PolicySource::load(name)?;
    let image = source.image().with_context(|| format!("{name} is no policy image: a module runs what is flashed"))?;
    let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let crc = format!("{:08x}", policy.crc());
    if arguments.policy.is_none() && crc != heading.crc32 {
        bail!(
            "the modules had another {name}: its checksum was {}, today it is {crc}; say which policy with --policy",
            heading.crc32
        );
    }
    let verdict = match arguments.emulation.launcher(image)? {
        Some(qemu) => replay::replay(&qemu, &log, &mut transcript, arguments.node),
        None => replay::replay(&InProcess::new(policy), &log, &mut transcript, arguments.node),
    }
    .with_context(|| path.display().to_string())?;
    if arguments.json {
        println!("{}", serde_json::to_string(&verdict)?);
    } else {
        print!("{}", table(&verdict, arguments));
    }
    match &verdict.first {
        None => Ok(()),
        Some(first) => bail!("module {} does not do the same: {}, {}", arguments.node, first.place, first.what),
    }
}

fn table(verdict: &Verdict, arguments: &Arguments) -> String {
    let mut text = format!(
        "module {} of {}, {}\n  {} runs, switched on {} times, polled {} times\n  {} torques compared, {} differ\n  {} frames compared, {} differ; {} in the log that it has not sent\n  {} answers differ in anything else\n",
        arguments.node,
        arguments.capture.display(),
        if arguments.emulation.qemu { "on an emulated microcontroller" } else { "in this process" },
        verdict.runs,
        verdict.starts,
        verdict.polls,
        verdict.torques,
        verdict.torques_different,
        verdict.frames,
        verdict.frames_different,
        verdict.foreign,
        verdict.answers_different,
    );
    if let Some(ended) = &verdict.ended {
        text += &format!("  compared up to there: {ended}\n");
    }
    text
}
