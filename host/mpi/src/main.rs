//! `mpirun -n 2 composer-ranks snakectl train ...`: starts the program on every rank with `--ranks` and exchanges for it what it hands over.
//!
//! The program's standard input is a socket. At its beginning it reads the rank and the number of ranks; for an exchange it writes the length of its
//! bytes and them, and reads the same of every rank in order. All numbers are 64 bits, little-endian. (`host/src/methods/ranks.rs` is the other end.)
//!
//! MPI gathers lengths, then bytes; nothing is added here, so that no order of additions depends on MPI.

use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::process::{Command, ExitCode, Stdio};

use mpi::datatype::PartitionMut;
use mpi::traits::{Communicator, CommunicatorCollectives};

/// Reads the length of the next exchange; none: the program has ended.
fn length(stream: &mut UnixStream) -> io::Result<Option<usize>> {
    let mut bytes = [0; 8];
    match stream.read_exact(&mut bytes) {
        Ok(()) => Ok(Some(u64::from_le_bytes(bytes) as usize)),
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(None),
        Err(error) => Err(error),
    }
}

/// Exchanges until the program ends.
fn serve(world: &impl CommunicatorCollectives, stream: &mut UnixStream) -> io::Result<()> {
    let count = world.size() as usize;
    stream.write_all(&[(world.rank() as u64).to_le_bytes(), (count as u64).to_le_bytes()].concat())?;
    while let Some(len) = length(stream)? {
        let mut own = vec![0u8; len];
        stream.read_exact(&mut own)?;
        let mut lengths = vec![0i32; count];
        let len = i32::try_from(len).map_err(|_| io::Error::other("more than 2 GiB in an exchange"))?;
        world.all_gather_into(&len, &mut lengths[..]);
        let starts: Vec<i32> = lengths
            .iter()
            .scan(0i32, |end, len| {
                let start = *end;
                *end = end.checked_add(*len)?;
                Some(start)
            })
            .collect();
        if starts.len() < count {
            return Err(io::Error::other("more than 2 GiB in an exchange"));
        }
        let mut all = vec![0u8; lengths.iter().map(|len| *len as usize).sum()];
        world.all_gather_varcount_into(&own[..], &mut PartitionMut::new(&mut all[..], &lengths[..], &starts[..]));
        let mut answer = Vec::with_capacity(all.len() + 8 * count);
        for (start, len) in starts.iter().zip(&lengths) {
            answer.extend_from_slice(&(*len as u64).to_le_bytes());
            answer.extend_from_slice(&all[*start as usize..(*start + *len) as usize]);
        }
        stream.write_all(&answer)?;
    }
    Ok(())
}

/// Ends all ranks: the others would wait for this one for ever.
fn fail(world: &impl Communicator, what: &str) -> ! {
    eprintln!("composer-ranks: rank {}: {what}", world.rank());
    world.abort(1)
}

fn main() -> ExitCode {
    let Some(universe) = mpi::initialize() else {
        eprintln!("composer-ranks: MPI has been initialised already");
        return ExitCode::FAILURE;
    };
    let world = universe.world();
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let Some((program, arguments)) = arguments.split_first() else {
        eprintln!(
            "composer-ranks: start it with a program, such as mpirun -n 2 composer-ranks snakectl train goal-reaching"
        );
        return ExitCode::FAILURE;
    };
    let (mut ours, theirs) = match UnixStream::pair() {
        Ok(pair) => pair,
        Err(error) => fail(&world, &format!("there is no socket: {error}")),
    };
    let theirs = Stdio::from(std::os::fd::OwnedFd::from(theirs));
    let mut child = match Command::new(program).args(arguments).arg("--ranks").stdin(theirs).spawn() {
        Ok(child) => child,
        Err(error) => fail(&world, &format!("{} cannot be started: {error}", program.to_string_lossy())),
    };
    let served = serve(&world, &mut ours);
    match child.wait() {
        Ok(status) if status.success() && served.is_ok() => ExitCode::SUCCESS,
        Ok(status) => {
            let why = served.err().map_or(String::new(), |error| format!(" ({error})"));
            fail(
                &world,
                &format!(
                    "{} ended with {status}{why}; the last checkpoint is whole, --resume goes on from it",
                    program.to_string_lossy()
                ),
            )
        }
        Err(error) => fail(&world, &format!("{error}")),
    }
}
