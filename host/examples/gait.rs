use composer_host::{robot::Robot, sim::Snake};
fn main() {
    let mut args = std::env::args().skip(1);
    let mut r = Robot::default();
    let mode = args.next().unwrap_or_default();
    if mode == "free" {
        r.joint_speed_limit = 1e9;
        r.damping = 0.874;
        r.torque_slew = 1e9;
    }
    if let Ok(v) = std::env::var("SLEW") {
        r.torque_slew = v.parse().unwrap();
    }
    if let Some(i) = args.next() {
        r.solver_iterations = i.parse().unwrap();
    }
    if let Ok(d) = std::env::var("DT") {
        r.physics_step = d.parse().unwrap();
    }
    if let Some(i) = args.next() {
        r.modules = i.parse().unwrap();
    }
    let mut s = Snake::new(&r);
    let e0 = s.energy();
    for _ in 0..50 {
        s.step();
    }
    println!("settled energy {e0} -> {} height {} gap {}", s.energy(), s.height(), s.joint_gap());
    let h0 = s.head();
    let t = std::time::Instant::now();
    let n = (10.0 / r.physics_step) as i32;
    let mut high = 0.0f32;
    let mut gap = 0.0f32;
    for i in 0..n {
        let time = i as f32 * r.physics_step;
        for m in 0..r.modules {
            let y = 0.8 * 80.0 * (2.0 * std::f32::consts::PI * time + 2.0 * m as f32).sin();
            s.set_torque(m, [y, 0.0]);
        }
        s.step();
        high += s.height() / n as f32;
        gap = gap.max(s.joint_gap());
    }
    let el = t.elapsed().as_secs_f64();
    let h = s.head();
    println!(
        "moved {:.2} {:.2} {:.2}; {:.0} steps/s -> {:.0} control steps/s; mean height {high:.2} gap {gap:.4} motion {:?}",
        h[0] - h0[0],
        h[1] - h0[1],
        h[2] - h0[2],
        n as f64 / el,
        n as f64 / el / 5.0,
        s.motion()
    );
}
