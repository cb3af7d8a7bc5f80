//! Running statistics: of the observations (shared by all modules) and of the returns.

/// Smallest standard deviation that is divided by. A field that hardly ever changes must not be blown up to the size of the others.
const STD_FLOOR: f64 = 1e-2;

/// Mean and variance of a vector, exact over everything seen, summed in double precision.
#[derive(Clone, Debug, PartialEq)]
pub struct Running {
    count: f64,
    mean: Vec<f64>,
    /// Sum of the squared distances from the mean.
    spread: Vec<f64>,
}

impl Running {
    /// Nothing seen of a vector of `size` numbers.
    pub fn new(size: usize) -> Self {
        Self { count: 0.0, mean: vec![0.0; size], spread: vec![0.0; size] }
    }

    /// As if so many vectors of this mean and standard deviation had been seen.
    pub fn known(mean: &[f32], std: &[f32], count: f64) -> Self {
        let spread = std.iter().map(|std| count * f64::from(*std).powi(2)).collect();
        Self { count, mean: mean.iter().map(|mean| f64::from(*mean)).collect(), spread }
    }

    /// Takes in one vector (Welford).
    pub fn push(&mut self, x: &[f32]) {
        self.count += 1.0;
        let share = 1.0 / self.count;
        for ((x, mean), spread) in x.iter().zip(&mut self.mean).zip(&mut self.spread) {
            let x = f64::from(*x);
            let delta = x - *mean;
            *mean += delta * share;
            *spread += delta * (x - *mean);
        }
    }

    /// Takes in all that another has seen (Chan et al.).
    pub fn merge(&mut self, other: &Running) {
        if other.count == 0.0 {
            return;
        }
        let total = self.count + other.count;
        let of_other = other.count / total;
        for i in 0..self.mean.len() {
            let delta = other.mean[i] - self.mean[i];
            self.mean[i] += delta * of_other;
            self.spread[i] += other.spread[i] + delta * delta * self.count * of_other;
        }
        self.count = total;
    }

    /// All numbers it is made of; [`Running::from_numbers`] takes them back.
    pub fn numbers(&self) -> impl Iterator<Item = f64> {
        std::iter::once(self.count).chain(self.mean.iter().copied()).chain(self.spread.iter().copied())
    }

    /// Takes `2 size + 1` numbers off the front of a list.
    pub fn from_numbers(size: usize, numbers: &mut impl Iterator<Item = f64>) -> Option<Self> {
        let count = numbers.next()?;
        let mean = (0..size).map(|_| numbers.next()).collect::<Option<_>>()?;
        let spread = (0..size).map(|_| numbers.next()).collect::<Option<_>>()?;
        Some(Self { count, mean, spread })
    }

    /// How many vectors have been seen.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Mean of each number; 0 before anything is seen.
    pub fn mean(&self) -> Vec<f32> {
        self.mean.iter().map(|mean| *mean as f32).collect()
    }

    /// Standard deviation of each number, at least 0.01; 1 before anything is seen.
    pub fn std(&self) -> Vec<f32> {
        let of = |spread: &f64| {
            if self.count < 1.0 { 1.0 } else { (spread / self.count).sqrt().max(STD_FLOOR) as f32 }
        };
        self.spread.iter().map(of).collect()
    }
}

/// Normalised numbers are clipped to this.
pub const CLIP: f32 = 5.0;

/// Mean and one over the standard deviation of some numbers, frozen for an iteration.
#[derive(Clone, Debug)]
pub struct Frozen {
    mean: Vec<f32>,
    scale: Vec<f32>,
    clip: f32,
}

impl Frozen {
    /// The statistics as they are now.
    pub fn new(running: &Running) -> Self {
        Self::with_clip(running, CLIP)
    }

    /// The same with another limit.
    pub fn with_clip(running: &Running, clip: f32) -> Self {
        Self { mean: running.mean(), scale: running.std().into_iter().map(f32::recip).collect(), clip }
    }

    /// Leaves so many numbers as they are.
    pub fn off(size: usize) -> Self {
        Self { mean: vec![0.0; size], scale: vec![1.0; size], clip: f32::MAX }
    }

    /// A number divided by the standard deviation, its mean left in, and clipped.
    pub fn scaled(&self, x: f32) -> f32 {
        (x * self.scale[0]).clamp(-self.clip, self.clip)
    }

    /// Appends the numbers, normalised and clipped; those beyond the statistics are left out.
    pub fn apply(&self, x: &[f32], out: &mut Vec<f32>) {
        let of = |((x, mean), scale): ((&f32, &f32), &f32)| ((x - mean) * scale).clamp(-self.clip, self.clip);
        out.extend(x.iter().zip(&self.mean).zip(&self.scale).map(of));
    }
}

/// How the statistics of the returns forget.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Forgetting {
    /// Old iterations fade, because returns grow while the policy gets better. For PopArt, which keeps what the critic says.
    #[default]
    Iterations,
    /// Nearly an average over all minibatches so far, debiased (ValueNorm of on-policy, HARL and MAT).
    Minibatches,
    /// Returns are taken as they are.
    Off,
}

/// Running mean and standard deviation of the returns, so that the critic learns numbers of size 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ValueNorm {
    /// How it forgets.
    pub forgetting: Forgetting,
    mean: f64,
    square: f64,
    weight: f64,
}

impl ValueNorm {
    /// Nothing seen.
    pub fn new(forgetting: Forgetting) -> Self {
        Self { forgetting, ..Self::default() }
    }

    /// What is left of the weight of what was seen when more comes in.
    fn decay(&self) -> f64 {
        match self.forgetting {
            Forgetting::Iterations => 0.95,
            Forgetting::Minibatches | Forgetting::Off => 0.99999,
        }
    }

    /// Takes in the returns of an iteration or a minibatch.
    pub fn update(&mut self, returns: &[f32]) {
        if returns.is_empty() || self.forgetting == Forgetting::Off {
            return;
        }
        let (n, decay) = (returns.len() as f64, self.decay());
        let mean = returns.iter().map(|r| f64::from(*r)).sum::<f64>() / n;
        let square = returns.iter().map(|r| f64::from(*r).powi(2)).sum::<f64>() / n;
        self.mean = decay * self.mean + (1.0 - decay) * mean;
        self.square = decay * self.square + (1.0 - decay) * square;
        self.weight = decay * self.weight + (1.0 - decay);
    }

    /// All numbers it is made of; [`ValueNorm::restore`] takes them back.
    pub fn numbers(&self) -> [f64; 3] {
        [self.mean, self.square, self.weight]
    }

    /// Goes back to what it was.
    pub fn restore(&mut self, [mean, square, weight]: [f64; 3]) {
        *self = Self { mean, square, weight, ..*self };
    }

    /// Mean of the returns; 0 before any were seen.
    pub fn mean(&self) -> f32 {
        if self.weight == 0.0 { 0.0 } else { (self.mean / self.weight.max(1e-5)) as f32 }
    }

    /// Standard deviation of the returns, at least 0.01, or 0.1 where minibatches are averaged; before any were seen 1, or 0.1 there.
    pub fn std(&self) -> f32 {
        let floor = match self.forgetting {
            Forgetting::Iterations => STD_FLOOR,
            Forgetting::Minibatches => 0.1,
            Forgetting::Off => return 1.0,
        };
        if self.weight == 0.0 {
            return if self.forgetting == Forgetting::Minibatches { 0.1 } else { 1.0 };
        }
        let weight = self.weight.max(1e-5);
        let mean = self.mean / weight;
        (self.square / weight - mean * mean).max(floor * floor).sqrt() as f32
    }

    /// From the critic's scale to the reward's.
    pub fn denormalise(&self, value: f32) -> f32 {
        value * self.std() + self.mean()
    }

    /// From the reward's scale to the critic's.
    pub fn normalise(&self, value: f32) -> f32 {
        (value - self.mean()) / self.std()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merging_parts_equals_seeing_the_whole() {
        let rows: Vec<[f32; 2]> = (0..50).map(|i| [i as f32 * 0.5 - 3.0, (i as f32).sin() * 10.0]).collect();
        let mut whole = Running::new(2);
        rows.iter().for_each(|row| whole.push(row));
        let mut merged = Running::new(2);
        for part in [&rows[..13], &rows[13..13], &rows[13..]] {
            let mut running = Running::new(2);
            part.iter().for_each(|row| running.push(row));
            merged.merge(&running);
        }
        assert_eq!(merged.count(), 50.0);
        let (a, b) = (whole.mean(), merged.mean());
        let (c, d) = (whole.std(), merged.std());
        for i in 0..2 {
            assert!((a[i] - b[i]).abs() < 1e-5 && (c[i] - d[i]).abs() < 1e-5);
        }
        assert!((a[0] - 9.25).abs() < 1e-5);
        assert!((c[0] - 7.2154).abs() < 1e-3);
    }

    #[test]
    fn returns_come_back_from_the_critics_scale() {
        let mut norm = ValueNorm::default();
        assert_eq!(norm.normalise(3.0), 3.0);
        norm.update(&[8.0, 12.0]);
        assert!((norm.mean() - 10.0).abs() < 1e-5 && (norm.std() - 2.0).abs() < 1e-5);
        assert!((norm.denormalise(norm.normalise(11.5)) - 11.5).abs() < 1e-5);
        norm.update(&[18.0, 22.0]);
        // The newer iteration weighs 1 / 0.95 of the older.
        assert!((norm.mean() - (9.5 + 20.0) / 1.95).abs() < 1e-4);
    }
}
