//! Eight modules on an ideal bus for some control cycles: a fixed piece of work to count instructions on.
//!
//! What one control step of one module costs is the difference between two runs, divided by cycles and modules:
//!
//!     valgrind --tool=callgrind --callgrind-out-file=/dev/null target/release/examples/control_step 1000
//!     valgrind --tool=callgrind --callgrind-out-file=/dev/null target/release/examples/control_step 2000
//!
//! It includes everything: frames parsed, kinematics, observation, encoder, attention, actor, frames built.

use composer_firmware::controller::{Boot, BusKind, Config, Controller};
use composer_firmware::failsafe::BusStatus;
use composer_shared::observation::Sensors;
use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_shared::robot::MAX_MODULES;

fn main() {
    let mut arguments = std::env::args().skip(1);
    let cycles: u64 = arguments.next().and_then(|a| a.parse().ok()).unwrap_or(1000);
    let modules: u8 = arguments.next().and_then(|a| a.parse().ok()).unwrap_or(8).clamp(1, MAX_MODULES as u8);
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    let policy = Policy::parse(&image).expect("a random image is valid");
    let mut robot: Vec<Controller> = (0..modules)
        .map(|node| {
            let config = Config::new(node, modules, BusKind::Fd, &policy);
            let mut module = Controller::new(config, policy, Boot::default(), 0).expect("a valid configuration");
            module.arm(false).expect("nothing forbids it");
            module
        })
        .collect();
    let mut sensors = Sensors { up: [0.0, 0.1, 0.99], temperature: 25.0, ..Sensors::ZERO };
    let mut deadlines = vec![0; robot.len()];
    let mut now = 0;
    let end = cycles * u64::from(policy.control_period_us());
    while now < end {
        sensors.joint_angles = [0.3, -0.2, 0.1, 0.05].map(|a: f32| a * ((now / 50_000) % 7) as f32 / 7.0);
        for (module, deadline) in robot.iter_mut().zip(&mut deadlines) {
            if *deadline <= now {
                *deadline = module.poll(now, &sensors, None, BusStatus::ErrorActive).deadline;
            }
        }
        // Every frame reaches everybody else at once, most urgent first.
        loop {
            let mut sent = None;
            for (node, module) in robot.iter_mut().enumerate() {
                if let Some(frame) = module.next_frame() {
                    sent = Some((node, frame));
                    break;
                }
            }
            let Some((sender, frame)) = sent else { break };
            for (node, module) in robot.iter_mut().enumerate().filter(|(node, _)| *node != sender) {
                deadlines[node] = module.poll(now, &sensors, Some(&frame), BusStatus::ErrorActive).deadline;
            }
        }
        now = deadlines.iter().copied().min().unwrap_or(end).max(now + 1);
    }
    println!(
        "{cycles} cycles of {modules} modules, {} acted by the first; a controller is {} bytes",
        robot[0].stats().acted,
        size_of::<Controller>()
    );
}
