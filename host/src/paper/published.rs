//! What the paper reports: the numbers of its Tables II and III (section IV-B), mean and standard error over three seeds.

use super::measure::Point;
use crate::methods::Method;

/// Methods that the paper's tables have.
pub const TABLED: [Method; 3] = [Method::Ppo, Method::Mappo, Method::Composer];

/// Success, distance at the end and control steps, each with its standard error.
pub type Numbers = [(f64, f64); 3];

/// The paper's numbers at a point.
#[allow(clippy::approx_constant)] // A distance of 3.14 units is no constant of mathematics.
pub fn numbers(method: Method, point: Point) -> Option<Numbers> {
    let row = TABLED.iter().position(|tabled| *tabled == method)?;
    let columns = match (point.fault, point.modules) {
        ("none", 8) => [
            [(0.51, 0.15), (3.14, 0.37), (102.42, 6.74)],
            [(0.76, 0.08), (2.35, 0.09), (93.01, 3.45)],
            [(0.90, 0.028), (2.08, 0.059), (82.78, 1.94)],
        ],
        ("action:1", 8) => [
            [(0.28, 0.084), (5.14, 0.61), (111.62, 3.77)],
            [(0.52, 0.093), (3.76, 0.54), (103.13, 3.81)],
            [(0.55, 0.073), (3.67, 0.35), (100.07, 1.07)],
        ],
        ("action:2", 8) => [
            [(0.17, 0.06), (6.50, 0.77), (116.67, 2.31)],
            [(0.28, 0.07), (5.30, 0.79), (112.36, 3.98)],
            [(0.33, 0.058), (5.19, 0.38), (110.62, 1.35)],
        ],
        ("observation:1", 8) => [
            [(0.35, 0.085), (4.66, 0.099), (108.94, 2.97)],
            [(0.44, 0.14), (5.20, 1.26), (106.29, 5.03)],
            [(0.39, 0.033), (4.61, 0.37), (105.07, 1.83)],
        ],
        ("none", 9) => [
            [(0.25, 0.01), (5.23, 0.26), (112.79, 1.51)],
            [(0.47, 0.05), (3.61, 0.21), (107.99, 1.58)],
            [(0.57, 0.20), (2.83, 0.40), (102.24, 4.28)],
        ],
        ("none", 10) => [
            [(0.067, 0.047), (7.10, 0.59), (120.43, 2.52)],
            [(0.10, 0.07), (7.14, 1.42), (119.41, 2.68)],
            [(0.35, 0.18), (4.20, 1.49), (111.25, 6.00)],
        ],
        ("none", 11) => [
            [(0.033, 0.023), (8.51, 1.73), (122.13, 1.32)],
            [(0.023, 0.02), (11.4, 1.70), (122.45, 0.71)],
            [(0.13, 0.09), (7.26, 2.72), (118.87, 3.15)],
        ],
        _ => return None,
    };
    Some(columns[row])
}
