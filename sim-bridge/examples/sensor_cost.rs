//! What the sensor model costs: `cargo run --release -p composer-sim-bridge --example sensor_cost`.
//!
//! Prints the CPU time for the sensors of 8 modules in one period, filters included.

use std::hint::black_box;
use std::time::Instant;

use composer_sim_bridge::sensor_model::{ModuleSensorState, SensorModel, Truth};

const MODULES: usize = 8;
const PERIODS: u32 = 200_000;

/// CPU time of this thread in seconds where Linux tells it, so that other load on the machine does not count.
fn cpu_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(stat.split_ascii_whitespace().next()?.parse::<f64>().ok()? / 1e9)
}

fn main() {
    for (name, model) in [("none", SensorModel::none()), ("default", SensorModel::default())] {
        let mut modules: Vec<_> = (0..MODULES as u64).map(|seed| ModuleSensorState::new(&model, seed)).collect();
        let truth =
            Truth { joints: 4, specific_force: [0.1, 0.2, 1.3], angular_rate: [0.5, -1.0, 2.0], ..Truth::default() };
        let mut best = f64::INFINITY;
        for _ in 0..5 {
            let (start, before) = (Instant::now(), cpu_seconds());
            for period in 0..PERIODS / 5 {
                let angle = 0.5 - (period % 1000) as f32 * 1e-3;
                for module in &mut modules {
                    module.update(black_box(&Truth { joint_angles: [angle; 4], ..truth }));
                }
            }
            let seconds = match (before, cpu_seconds()) {
                (Some(before), Some(after)) => after - before,
                _ => start.elapsed().as_secs_f64(),
            };
            best = best.min(seconds * 1e6 / f64::from(PERIODS / 5));
        }
        println!("{name}: {best:.2} us a period for {MODULES} modules; {:?}", modules[0].sensors([0.0; 2], 25.0).up);
    }
}
