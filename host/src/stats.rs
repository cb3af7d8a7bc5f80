//! What a share of episodes says about the policy, and what some runs say about their mean.

use serde::Serialize;

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

/// 97.5 % of Student's t with 1 to 30 degrees of freedom lie below these.
const T: [f64; 30] = [
    12.706_205, 4.302_653, 3.182_446, 2.776_445, 2.570_582, 2.446_912, 2.364_624, 2.306_004, 2.262_157, 2.228_139,
    2.200_985, 2.178_813, 2.160_369, 2.144_787, 2.131_450, 2.119_905, 2.109_816, 2.100_922, 2.093_024, 2.085_963,
    2.079_614, 2.073_873, 2.068_658, 2.063_899, 2.059_539, 2.055_529, 2.051_831, 2.048_407, 2.045_230, 2.042_272,
];

/// Mean of some differences and half the width of its 95 % interval (Student); no width for fewer than two. Beyond 31 of them the normal
/// distribution's is taken, 4 % too narrow at most.
pub fn paired(differences: &[f64]) -> Option<(f64, Option<f64>)> {
    let n = differences.len();
    if n == 0 {
        return None;
    }
    let mean = differences.iter().sum::<f64>() / n as f64;
    let half = (n > 1).then(|| {
        let variance = differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / (n - 1) as f64;
        T.get(n - 2).copied().unwrap_or(Z) * (variance / n as f64).sqrt()
    });
    Some((mean, half))
}

/// A straight line through weighted points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Where it is at x = 0.
    pub end: f64,
    /// How much it rises for 1 of x.
    pub slope: f64,
}

/// The line of least weighted squares through (x, y, weight); none through fewer than two different x.
pub fn weighted_line(points: &[(f64, f64, f64)]) -> Option<Line> {
    let sum = |f: &dyn Fn(&(f64, f64, f64)) -> f64| points.iter().map(f).sum::<f64>();
    let weight = sum(&|p| p.2);
    let (mx, my) = (sum(&|p| p.2 * p.0) / weight, sum(&|p| p.2 * p.1) / weight);
    let spread = sum(&|p| p.2 * (p.0 - mx).powi(2));
    let slope = sum(&|p| p.2 * (p.0 - mx) * (p.1 - my)) / spread;
    let line = Line { end: my - slope * mx, slope };
    (spread > 1e-12 && line.end.is_finite()).then_some(line)
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

    #[test]
    fn paired_differences_have_students_interval() {
        // Student's sleep data (1908), the ten differences: mean 1.58, interval 0.70 to 2.46.
        let sleep = [1.2, 2.4, 1.3, 1.3, 0.0, 1.0, 1.8, 0.8, 4.6, 1.4];
        let (mean, half) = paired(&sleep).unwrap();
        assert!((mean - 1.58).abs() < 1e-9 && (half.unwrap() - 0.879_89).abs() < 1e-4, "{mean} {half:?}");
        assert_eq!(paired(&[0.5]), Some((0.5, None)));
        assert_eq!(paired(&[]), None);
    }

    #[test]
    fn a_line_goes_through_points_on_it_whatever_their_weight() {
        let line = weighted_line(&[(-2.0, 1.0, 3.0), (-1.0, 1.5, 1.0), (0.0, 2.0, 10.0)]).unwrap();
        assert!((line.end - 2.0).abs() < 1e-12 && (line.slope - 0.5).abs() < 1e-12);
        assert_eq!(weighted_line(&[(1.0, 1.0, 1.0)]), None);
    }
}
