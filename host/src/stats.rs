//! What a share of episodes says about the policy.

/// 1.96: 95 % of a normal distribution lie within so many standard deviations.
const Z: f64 = 1.959_963_984_540_054;

/// Wilson's 95 % interval for the rate behind `successes` of `trials` (Wilson 1927). Unlike the standard error of the share it has a width at 0
/// and at 1, too: 200 of 200 may be a rate of 0.981.
pub fn wilson(successes: usize, trials: usize) -> (f64, f64) {
    if trials == 0 {
        return (0.0, 1.0);
    }
    let (n, share) = (trials as f64, successes as f64 / trials as f64);
    let scale = 1.0 + Z * Z / n;
    let centre = share + Z * Z / (2.0 * n);
    let half = Z * (share * (1.0 - share) / n + Z * Z / (4.0 * n * n)).sqrt();
    // Rounding must not take the share itself out of its interval.
    (((centre - half) / scale).clamp(0.0, share), ((centre + half) / scale).clamp(share, 1.0))
}

/// A share and its interval as tables print them: `0.985 [0.957, 0.995]`.
pub fn with_interval(share: f64, low: f64, high: f64, digits: usize) -> String {
    format!("{share:.digits$} [{low:.digits$}, {high:.digits$}]")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_is_wilsons() {
        // Computed apart from this code, in double precision.
        for (successes, trials, low, high) in [
            (200, 200, 0.981_154_674, 1.0),
            (0, 200, 0.0, 0.018_845_326),
            (197, 200, 0.956_834_271, 0.994_885_762),
            (8, 10, 0.490_162_472, 0.943_317_849),
            (250, 500, 0.456_341_265, 0.543_658_735),
            (0, 0, 0.0, 1.0),
        ] {
            let (l, h) = wilson(successes, trials);
            assert!((l - low).abs() < 1e-8 && (h - high).abs() < 1e-8, "{successes} of {trials}: {l} {h}");
        }
        for trials in 1..60 {
            for successes in 0..=trials {
                let (low, high) = wilson(successes, trials);
                let share = successes as f64 / trials as f64;
                assert!(0.0 <= low && low <= share && share <= high && high <= 1.0 && low < high);
            }
        }
        assert_eq!(with_interval(0.985, 0.9568, 0.9949, 3), "0.985 [0.957, 0.995]");
    }
}
