//! `snakectl key`: keys that policies are signed with.

use std::path::PathBuf;

use anyhow::Result;

use crate::signing::{self, public_path};

/// Arguments of `key`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum Verb {
    /// Make a secret key, which only you can read, and its public key beside it (FILE.pub)
    New {
        /// Where; neither file may be there
        file: PathBuf,
    },
    /// Show what a key file is, and the public key
    Show {
        /// A secret or a public key
        file: PathBuf,
    },
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    match &arguments.verb {
        Verb::New { file } => {
            let key = signing::make_key(file)?;
            println!(
                "secret key {}, public key {}: {}",
                file.display(),
                public_path(file).display(),
                signing::name(&key)
            );
            println!(
                "keep the secret key to yourself and a copy of it elsewhere: without it the modules' policy is changed by a debug probe alone"
            );
        }
        Verb::Show { file } => {
            let (kind, key) = signing::show_key(file)?;
            let digits: String = key.iter().map(|byte| format!("{byte:02x}")).collect();
            println!("{}: a {kind} key, {}\npublic key: {digits}", file.display(), signing::name(&key));
        }
    }
    Ok(())
}
