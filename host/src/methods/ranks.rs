//! Several processes (ranks) that train one policy together, each a share of the environments and of the gradients.
//!
//! After a rollout every rank gets what the environments of the others went through, so that all have the same rollout buffer. The chunks of
//! a minibatch ([`super::on_policy::update()`]) are shared out; everybody gets the sums of all chunks and adds them in their order. All the rest, all ranks do
//! alike. So any number of ranks comes to the parameters of one process, bit for bit, and a checkpoint of one goes on with another number.

use std::io::{Read, Write};
use std::ops::Range;
use std::sync::{Arc, Mutex};

use anyhow::Context;

use crate::environment::Outcome;
use crate::methods::on_policy::{Decisions, Gradient, Trajectory};

/// What connects a rank to the others.
pub trait Ranks: std::fmt::Debug + Send + Sync {
    /// The number of this rank, from 0 on.
    fn rank(&self) -> usize;

    /// How many there are.
    fn count(&self) -> usize;

    /// Hands everybody's bytes to everybody, in the order of the ranks; waits for the last. Ends the process if another one has ended: nobody can go
    /// on without it.
    fn all_gather(&self, own: &[u8]) -> Vec<Vec<u8>>;

    /// The share of this rank of so many pieces.
    fn share(&self, pieces: usize) -> Range<usize> {
        share(pieces, self.rank(), self.count())
    }
}

/// The pieces of one of `count` ranks: neighbours, at most one more or less than any other's.
pub fn share(pieces: usize, rank: usize, count: usize) -> Range<usize> {
    rank * pieces / count..(rank + 1) * pieces / count
}

/// A rank whose connection is a stream to a program that exchanges for it (`host/mpi`).
///
/// The other end begins with the rank and the number of ranks; an exchange is the length of the own bytes and they, and in return the same of every
/// rank in order. All numbers are 64 bits, little-endian.
#[derive(Debug)]
pub struct Connected<S> {
    rank: usize,
    count: usize,
    stream: Mutex<S>,
}

fn number(stream: &mut impl Read) -> std::io::Result<usize> {
    let mut bytes = [0; 8];
    stream.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes) as usize)
}

impl<S: Read + Write + Send> Connected<S> {
    /// Waits for the other end's first words.
    ///
    /// # Errors
    ///
    /// If there is no such program at the other end.
    pub fn new(mut stream: S) -> std::io::Result<Self> {
        let (rank, count) = (number(&mut stream)?, number(&mut stream)?);
        if rank >= count {
            return Err(std::io::Error::other(format!("rank {rank} of {count}")));
        }
        Ok(Self { rank, count, stream: Mutex::new(stream) })
    }

    fn exchange(&self, own: &[u8]) -> std::io::Result<Vec<Vec<u8>>> {
        let mut stream = self.stream.lock().map_err(|_| std::io::Error::other("an exchange failed before"))?;
        stream.write_all(&(own.len() as u64).to_le_bytes())?;
        stream.write_all(own)?;
        stream.flush()?;
        let one = |_| {
            let mut bytes = vec![0; number(&mut *stream)?];
            stream.read_exact(&mut bytes)?;
            Ok(bytes)
        };
        (0..self.count).map(one).collect()
    }
}

impl<S: Read + Write + Send + std::fmt::Debug> Ranks for Connected<S> {
    fn rank(&self) -> usize {
        self.rank
    }

    fn count(&self) -> usize {
        self.count
    }

    fn all_gather(&self, own: &[u8]) -> Vec<Vec<u8>> {
        self.exchange(own).unwrap_or_else(|error| {
            eprintln!(
                "snakectl: rank {} of {} lost the others ({error}); the last checkpoint is whole, --resume goes on from it",
                self.rank, self.count
            );
            std::process::exit(1);
        })
    }
}

/// The connection that `composer-ranks` (`host/mpi`) hands a rank as its standard input.
///
/// # Errors
///
/// If it was not started so.
#[cfg(unix)]
pub fn on_standard_input() -> anyhow::Result<Arc<dyn Ranks>> {
    use std::os::fd::AsFd;
    use std::os::unix::net::UnixStream;
    let stream = UnixStream::from(std::io::stdin().as_fd().try_clone_to_owned()?);
    if stream.peer_addr().is_err() {
        anyhow::bail!(
            "--ranks is for `mpirun -n 2 composer-ranks snakectl train ...`, which connects the ranks; host/mpi/README.md says how to build it"
        );
    }
    Ok(Arc::new(Connected::new(stream).context("composer-ranks says nothing")?))
}

/// See above.
#[cfg(not(unix))]
pub fn on_standard_input() -> anyhow::Result<Arc<dyn Ranks>> {
    anyhow::bail!("--ranks needs Unix sockets, which this system has not")
}

/// Bytes that are written in order, and read again in the same one.
#[derive(Debug, Default)]
pub struct Parcel(Vec<u8>);

/// See [`Parcel`]. What is missing reads as nothing; only other ranks of the same program write it.
#[derive(Debug)]
pub struct Opened<'a>(&'a [u8]);

/// Numbers as bytes, exactly.
pub trait Word: Copy {
    /// Writes it.
    fn put(self, to: &mut Vec<u8>);
    /// Reads it off the front.
    fn take(from: &mut &[u8]) -> Option<Self>;
}

macro_rules! word {
    ($($number:ty),*) => {$(
        impl Word for $number {
            fn put(self, to: &mut Vec<u8>) {
                to.extend_from_slice(&self.to_le_bytes());
            }

            fn take(from: &mut &[u8]) -> Option<Self> {
                let (first, rest) = from.split_first_chunk()?;
                *from = rest;
                Some(Self::from_le_bytes(*first))
            }
        }
    )*};
}
word!(f32, f64, u64, u32);

impl Word for bool {
    fn put(self, to: &mut Vec<u8>) {
        to.push(self.into());
    }

    fn take(from: &mut &[u8]) -> Option<Self> {
        let (first, rest) = from.split_first()?;
        *from = rest;
        Some(*first != 0)
    }
}

impl Word for [f32; 2] {
    fn put(self, to: &mut Vec<u8>) {
        self.into_iter().for_each(|x| x.put(to));
    }

    fn take(from: &mut &[u8]) -> Option<Self> {
        Some([f32::take(from)?, f32::take(from)?])
    }
}

impl Word for Outcome {
    fn put(self, to: &mut Vec<u8>) {
        let Outcome { reward, terminated, truncated, success, distance, steps, episode_return, troubles } = self;
        [reward, distance, episode_return].into_iter().for_each(|x| x.put(to));
        [terminated, truncated, success].into_iter().for_each(|x| x.put(to));
        [steps, troubles].into_iter().for_each(|x| x.put(to));
    }

    fn take(from: &mut &[u8]) -> Option<Self> {
        let [reward, distance, episode_return] = [f32::take(from)?, f32::take(from)?, f32::take(from)?];
        let [terminated, truncated, success] = [bool::take(from)?, bool::take(from)?, bool::take(from)?];
        let [steps, troubles] = [u32::take(from)?, u32::take(from)?];
        Some(Outcome { reward, terminated, truncated, success, distance, steps, episode_return, troubles })
    }
}

impl Parcel {
    /// Adds a list.
    pub fn list<T: Word>(&mut self, list: &[T]) {
        (list.len() as u64).put(&mut self.0);
        list.iter().for_each(|x| x.put(&mut self.0));
    }

    /// Adds a trajectory with what policies did in it.
    pub fn trajectory(&mut self, trajectory: &Trajectory, decisions: [&Decisions; 2]) {
        let t = trajectory;
        self.list(&[t.modules as u64]);
        let floats = [&t.observations, &t.privileged, &t.rewards, &t.companion_errors, &t.final_observations];
        floats.into_iter().chain([&t.final_privileged]).for_each(|list| self.list(list));
        [&t.heard, &t.final_heard].into_iter().for_each(|list| self.list(list));
        [&t.acts, &t.terminated, &t.truncated].into_iter().for_each(|list| self.list(list));
        self.list(&t.episodes);
        for d in decisions {
            // What the critic says of it is not known yet.
            [&d.actions, &d.log_probabilities, &d.memory, &d.rewards].into_iter().for_each(|list| self.list(list));
        }
    }

    /// Adds a sum of gradients.
    pub fn gradient(&mut self, sum: &Gradient) {
        self.list(&sum.gradient);
        self.list(&[sum.policy_loss, sum.value_loss, sum.kl, sum.clipped]);
    }

    /// All of it.
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }
}

impl<'a> Opened<'a> {
    /// Begins at the front.
    pub fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }

    /// Takes a list.
    pub fn list<T: Word>(&mut self) -> Vec<T> {
        let count = u64::take(&mut self.0).unwrap_or(0);
        (0..count).map_while(|_| T::take(&mut self.0)).collect()
    }

    /// Takes a trajectory with what policies did in it.
    pub fn trajectory(&mut self, t: &mut Trajectory, decisions: [&mut Decisions; 2]) {
        t.modules = self.list::<u64>().first().map_or(0, |modules| *modules as usize);
        for list in [
            &mut t.observations,
            &mut t.privileged,
            &mut t.rewards,
            &mut t.companion_errors,
            &mut t.final_observations,
            &mut t.final_privileged,
        ] {
            *list = self.list();
        }
        [&mut t.heard, &mut t.final_heard].into_iter().for_each(|list| *list = self.list());
        [&mut t.acts, &mut t.terminated, &mut t.truncated].into_iter().for_each(|list| *list = self.list());
        t.episodes = self.list();
        for d in decisions {
            for list in [&mut d.actions, &mut d.log_probabilities, &mut d.memory, &mut d.rewards] {
                *list = self.list();
            }
        }
    }

    /// Takes a sum of gradients.
    pub fn gradient(&mut self, sum: &mut Gradient) {
        sum.gradient = self.list();
        let numbers = self.list::<f64>();
        let at = |i: usize| numbers.get(i).copied().unwrap_or(0.0);
        (sum.policy_loss, sum.value_loss, sum.kl, sum.clipped) = (at(0), at(1), at(2), at(3));
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::os::unix::net::UnixStream;

    use super::*;

    /// Connected ranks in this process, with a thread that exchanges for them as `host/mpi` does.
    pub fn in_this_process(count: usize) -> Vec<Connected<UnixStream>> {
        let (theirs, mut ours): (Vec<_>, Vec<_>) = (0..count).map(|_| UnixStream::pair().unwrap()).unzip();
        std::thread::spawn(move || {
            for (rank, stream) in ours.iter_mut().enumerate() {
                stream.write_all(&[(rank as u64).to_le_bytes(), (count as u64).to_le_bytes()].concat()).unwrap();
            }
            loop {
                let mut all = Vec::new();
                for stream in &mut ours {
                    // The ranks are done.
                    let Ok(len) = number(stream) else { return };
                    let mut bytes = vec![0; len];
                    stream.read_exact(&mut bytes).unwrap();
                    all.push(bytes);
                }
                for stream in &mut ours {
                    for bytes in &all {
                        stream.write_all(&(bytes.len() as u64).to_le_bytes()).unwrap();
                        stream.write_all(bytes).unwrap();
                    }
                }
            }
        });
        theirs.into_iter().map(|stream| Connected::new(stream).unwrap()).collect()
    }

    #[test]
    fn everybody_hears_everybody_in_order() {
        let said = |rank: usize, round: usize| vec![rank as u8; 3 * rank + 10_000 * round];
        std::thread::scope(|scope| {
            for ranks in in_this_process(3) {
                scope.spawn(move || {
                    for round in 0..3 {
                        let all = ranks.all_gather(&said(ranks.rank(), round));
                        assert_eq!(all, (0..3).map(|rank| said(rank, round)).collect::<Vec<_>>());
                    }
                });
            }
        });
    }

    #[test]
    fn shares_are_all_of_it() {
        for (pieces, count) in [(8, 3), (2, 5), (0, 2), (7, 1)] {
            let all: Vec<usize> = (0..count).flat_map(|rank| share(pieces, rank, count)).collect();
            assert_eq!(all, (0..pieces).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_parcel_is_opened_as_it_was_packed() {
        let trajectory = Trajectory {
            modules: 2,
            observations: vec![1.5, -0.0],
            heard: vec![u64::MAX, 3],
            acts: vec![true, false],
            episodes: vec![Outcome { steps: 7, success: true, distance: 0.1, ..Outcome::default() }],
            final_heard: vec![1],
            ..Trajectory::default()
        };
        let decisions = Decisions { actions: vec![0.25; 3], rewards: vec![f32::MIN_POSITIVE], ..Decisions::default() };
        let sum = Gradient { gradient: vec![1e-30, 2.0], kl: 0.1, clipped: 0.2, ..Gradient::default() };
        let mut parcel = Parcel::default();
        parcel.trajectory(&trajectory, [&decisions, &Decisions::default()]);
        parcel.gradient(&sum);
        let mut opened = Opened::new(parcel.bytes());
        let (mut t, mut d, mut other, mut g) =
            (Trajectory::default(), Decisions::default(), Decisions::default(), Gradient::default());
        opened.trajectory(&mut t, [&mut d, &mut other]);
        opened.gradient(&mut g);
        assert_eq!(format!("{t:?}{d:?}{g:?}"), format!("{trajectory:?}{decisions:?}{sum:?}"));
        assert!(opened.0.is_empty());
    }
}
