use composer_host::{env::*, environment::*, robot::Robot};
use std::sync::Arc;
fn main() {
    let mut c = EnvConfig::new(Robot::default());
    if let Some(i) = std::env::args().nth(1) {
        c.robot.solver_iterations = i.parse().unwrap();
    }
    if let Ok(v) = std::env::var("SLEW") {
        c.robot.torque_slew = v.parse().unwrap();
    }
    let threads: usize = std::env::args().nth(2).map_or(1, |a| a.parse().unwrap());
    let c = Arc::new(c);
    let t = std::time::Instant::now();
    let n = 2000;
    std::thread::scope(|s| {
        for th in 0..threads {
            let c = c.clone();
            s.spawn(move || {
                let mut e = SnakeEnv::new(c);
                let mut v = View::default();
                let mut x = 1u32 + th as u32;
                let mut seed = 0;
                let mut hi = 0;
                let mut m = composer_host::sim::Motion::default();
                let mut a = vec![[0.0f32; 2]; 8];
                for _ in 0..n {
                    e.view(&mut v);
                    for q in &mut a {
                        for k in 0..2 {
                            x = x.wrapping_mul(1664525).wrapping_add(1013904223);
                            q[k] = 0.6 * q[k] + 0.9 * ((x >> 8) as f32 / 8388608.0 - 1.0);
                        }
                    }
                    let o = e.step(&a);
                    if o.terminated || o.truncated {
                        hi += o.steps - e.low_steps();
                        m.peak_link_speed = m.peak_link_speed.max(e.motion().peak_link_speed);
                        m.peak_height = m.peak_height.max(e.motion().peak_height);
                        m.peak_joint_speed = m.peak_joint_speed.max(e.motion().peak_joint_speed);
                        seed += 1;
                        e.reset(seed);
                    }
                }
                println!("high {hi} of {n} {m:?}");
            });
        }
    });
    let el = t.elapsed().as_secs_f64();
    println!("{:.0} control steps/s", (n * threads) as f64 / el);
}
