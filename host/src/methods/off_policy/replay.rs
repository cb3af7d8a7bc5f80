//! The replay buffer: the latest transitions, drawn uniformly.

use composer_shared::observation::BASE;
use rand::{Rng, RngExt};

use crate::methods::on_policy::collect::ACTIONS;

/// Some transitions of teams of equal length, row-major. An episode that was cut off is not done, and what was seen next is its true last
/// view, not the first of the next episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Transitions {
    /// Modules of each team.
    pub modules: usize,
    /// Observations, `[teams][module][BASE]`.
    pub observations: Vec<f32>,
    /// Who heard whom, `[teams][module]`, own bit set.
    pub heard: Vec<u64>,
    /// Actions taken, clipped, `[teams][module][ACTIONS]`.
    pub actions: Vec<f32>,
    /// The team's reward, `[teams]`.
    pub rewards: Vec<f32>,
    /// 1 where nothing could be earned after, else 0.
    pub done: Vec<f32>,
    /// What was seen next, like `observations`.
    pub next_observations: Vec<f32>,
    /// Who heard whom then.
    pub next_heard: Vec<u64>,
}

impl Transitions {
    /// Transitions in it.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Puts transition `from` of another at the place `to`, or behind the last.
    fn put(&mut self, to: usize, other: &Transitions, from: usize) {
        fn copy<T: Copy>(to: &mut Vec<T>, other: &[T], width: usize, at: usize, from: usize) {
            let numbers = &other[from * width..(from + 1) * width];
            if to.len() == at * width {
                to.extend_from_slice(numbers)
            } else {
                to[at * width..(at + 1) * width].copy_from_slice(numbers)
            }
        }
        let n = self.modules;
        copy(&mut self.observations, &other.observations, n * BASE, to, from);
        copy(&mut self.heard, &other.heard, n, to, from);
        copy(&mut self.actions, &other.actions, n * ACTIONS, to, from);
        copy(&mut self.rewards, &other.rewards, 1, to, from);
        copy(&mut self.done, &other.done, 1, to, from);
        copy(&mut self.next_observations, &other.next_observations, n * BASE, to, from);
        copy(&mut self.next_heard, &other.next_heard, n, to, from);
    }
}

/// The latest transitions, up to a capacity. One takes 2.6 kB for a team of eight.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayBuffer {
    capacity: usize,
    all: Transitions,
    /// Where the next one goes.
    next: usize,
}

impl ReplayBuffer {
    /// An empty one for so many transitions of teams of `modules`.
    pub fn new(capacity: usize, modules: usize) -> Self {
        Self { capacity, all: Transitions { modules, ..Transitions::default() }, next: 0 }
    }

    /// Transitions in it.
    pub fn len(&self) -> usize {
        self.all.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Takes in some transitions; the oldest make room.
    pub fn push(&mut self, new: &Transitions) {
        for from in 0..new.len() {
            self.all.put(self.next, new, from);
            self.next = (self.next + 1) % self.capacity;
        }
    }

    /// Draws so many, any of them more than once.
    pub fn sample(&self, count: usize, rng: &mut impl Rng) -> Transitions {
        let mut drawn = Transitions { modules: self.all.modules, ..Transitions::default() };
        for to in 0..count {
            drawn.put(to, &self.all, rng.random_range(0..self.len()));
        }
        drawn
    }

    /// All numbers it is made of; [`ReplayBuffer::restore`] takes them back.
    pub fn numbers(&self) -> Vec<f32> {
        // Masks of 64 bits as two numbers with the bits of their halves.
        let halves = |masks: &[u64]| -> Vec<f32> {
            masks.iter().flat_map(|m| [*m as u32, (m >> 32) as u32].map(f32::from_bits)).collect()
        };
        let Transitions { observations, heard, actions, rewards, done, next_observations, next_heard, .. } = &self.all;
        let head = [self.len() as u32, self.next as u32].map(f32::from_bits);
        [&head[..], observations, &halves(heard), actions, rewards, done, next_observations, &halves(next_heard)]
            .concat()
    }

    /// Goes back to what it was; false if these numbers are of no buffer like this.
    pub fn restore(&mut self, numbers: &[f32]) -> bool {
        let n = self.all.modules;
        let [len, next, rest @ ..] = numbers else { return false };
        let [len, next] = [len, next].map(|x| x.to_bits() as usize);
        let each = 2 * n * BASE + 4 * n + n * ACTIONS + 2;
        if len > self.capacity || next > len || len.checked_mul(each) != Some(rest.len()) {
            return false;
        }
        let mut rest = rest;
        let mut take = |width: usize| {
            let (taken, others) = rest.split_at(len * width);
            rest = others;
            taken.to_vec()
        };
        let masks = |halves: Vec<f32>| -> Vec<u64> {
            let of = |[low, high]: &[f32; 2]| u64::from(low.to_bits()) | u64::from(high.to_bits()) << 32;
            halves.as_chunks::<2>().0.iter().map(of).collect()
        };
        self.all.observations = take(n * BASE);
        self.all.heard = masks(take(2 * n));
        self.all.actions = take(n * ACTIONS);
        self.all.rewards = take(1);
        self.all.done = take(1);
        self.all.next_observations = take(n * BASE);
        self.all.next_heard = masks(take(2 * n));
        self.next = next % self.capacity;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::random::{Stream, stream};

    fn transitions(from: usize, count: usize) -> Transitions {
        let number = |i: usize| (from + i) as f32;
        Transitions {
            modules: 2,
            observations: (0..count * 2 * BASE).map(|i| number(i / (2 * BASE))).collect(),
            heard: vec![u64::MAX; 2 * count],
            actions: (0..count * 2 * ACTIONS).map(|i| number(i / (2 * ACTIONS))).collect(),
            rewards: (0..count).map(number).collect(),
            done: vec![0.0; count],
            next_observations: (0..count * 2 * BASE).map(|i| number(i / (2 * BASE)) + 0.5).collect(),
            next_heard: vec![1 << 40; 2 * count],
        }
    }

    #[test]
    fn the_oldest_make_room_and_what_is_drawn_belongs_together() {
        let mut buffer = ReplayBuffer::new(5, 2);
        buffer.push(&transitions(0, 3));
        buffer.push(&transitions(3, 4));
        assert_eq!(buffer.len(), 5);
        let drawn = buffer.sample(200, &mut stream(1, Stream::Shuffle, 0, 0));
        let mut seen = [0; 7];
        for (i, reward) in drawn.rewards.iter().enumerate() {
            seen[*reward as usize] += 1;
            assert!(drawn.observations[i * 2 * BASE..(i + 1) * 2 * BASE].iter().all(|o| o == reward));
            assert!(drawn.next_observations[i * 2 * BASE..(i + 1) * 2 * BASE].iter().all(|o| *o == reward + 0.5));
            assert!(drawn.actions[i * 4..(i + 1) * 4].iter().all(|a| a == reward));
        }
        assert!(seen[..2] == [0, 0] && seen[2..].iter().all(|n| *n > 15), "{seen:?}");
    }

    #[test]
    fn it_comes_back_from_its_numbers() {
        let mut buffer = ReplayBuffer::new(5, 2);
        buffer.push(&transitions(0, 7));
        let mut other = ReplayBuffer::new(5, 2);
        assert!(other.restore(&buffer.numbers()));
        assert_eq!(other, buffer);
        assert!(!ReplayBuffer::new(5, 3).restore(&buffer.numbers()));
        assert!(!ReplayBuffer::new(4, 2).restore(&buffer.numbers()));
        assert!(!other.restore(&[]));
    }
}
