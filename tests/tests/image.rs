//! What the linked images contain, proved on the images themselves: no panic in the control step, and no more memory than
//! `firmware/budgets.toml` allows.
//!
//! The instructions of every function are read for calls and for what they do to the stack pointer. Both are upper bounds: a function
//! counts as if it always took all the stack that it ever takes.

#[path = "common/arm.rs"]
#[allow(dead_code)] // Nothing runs here.
mod arm;
#[path = "common/elf.rs"]
mod elf;
#[path = "common/thumb.rs"]
mod thumb;

use std::path::Path;

use composer_shared::policy::IMAGE_SIZE;
use elf::Image;
use serde::Deserialize;

/// What runs in the control step.
const CONTROL_STEP: [&str; 2] =
    ["composer_firmware::controller::Controller::poll", "composer_firmware::controller::Controller::next_frame"];
/// What runs after it, in images that have a service.
const SERVICE: [&str; 2] =
    ["composer_firmware::service::Service::poll", "composer_firmware::service::Service::next_frame"];
/// What checks the signature of a new policy, as a part of the service.
const SIGNATURE: [&str; 1] = ["composer_firmware::update::verify::verify"];
/// What decides about the transmit slots, and what takes a stop to the motors, in the interrupts of the board.
const INTERRUPTS: [&str; 4] = [
    "composer_firmware::port::Sender::push",
    "composer_firmware::port::Sender::poll",
    "composer_firmware::torque_off::TorqueOff::hear",
    "composer_firmware::torque_off::TorqueOff::trip",
];
/// Where every panic ends.
const PANIC: &str = "__rustc::rust_begin_unwind";
/// What an exception pushes, with the registers of the floating-point unit (ARMv7-M ARM, B1.5.7), aligned to 8 bytes.
const EXCEPTION_FRAME: u32 = 104 + 4;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Budgets {
    image: Vec<Budget>,
}

#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum Place {
    Inside,
    Apart,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Budget {
    program: String,
    features: String,
    policy: Place,
    flash: u64,
    step_stack: u32,
    /// None: the image has no service.
    service_stack: Option<u32>,
    signature_stack: Option<u32>,
    /// Counted in `bench_firmware.rs`.
    #[serde(rename = "signature_instructions")]
    _signature_instructions: Option<u64>,
    #[serde(rename = "kilobyte_instructions")]
    _kilobyte_instructions: Option<u64>,
    ram: Option<u64>,
    #[serde(default)]
    interrupts: Vec<String>,
    #[serde(default)]
    last_words: Vec<String>,
}

fn budgets() -> Vec<Budget> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../firmware/budgets.toml");
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    toml::from_str::<Budgets>(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display())).image
}

impl Budget {
    fn image(&self) -> Image {
        Image::read(&arm::image(&self.program, &self.features))
    }

    /// The most stack below any of the functions, and a table of the chain of calls that takes it.
    fn deepest(&self, image: &Image, functions: &[&str]) -> (u32, Vec<String>) {
        let entries = functions.iter().flat_map(|name| image.entry(name));
        let leave_out = |name: &str| self.last_words.iter().any(|words| name.starts_with(words));
        let depths = entries.map(|entry| image.stack(entry, &leave_out));
        let depths =
            depths.map(|depth| depth.unwrap_or_else(|e| panic!("the stack of {} has no bound: {e}", self.program)));
        depths.max().unwrap_or_default()
    }
}

/// A complaint if something takes more than it may.
fn check(program: &str, what: &str, bytes: u64, limit: u64, why: &[String]) -> Option<String> {
    println!("{program}: {what} {bytes} of {limit} bytes");
    let why = why.iter().map(|line| format!("\n    {line}"));
    (bytes > limit).then(|| {
        format!(
            "{program}: {what} takes {bytes} bytes, {} more than the {limit} that firmware/budgets.toml allows{}",
            bytes - limit,
            why.collect::<String>()
        )
    })
}

#[test]
fn images_stay_within_their_budgets() {
    let mut complaints = Vec::new();
    for budget in budgets() {
        let (image, program) = (budget.image(), &budget.program);
        let policy = if matches!(budget.policy, Place::Apart) { IMAGE_SIZE as u64 } else { 0 };
        complaints.extend(check(program, "flash", image.flash + policy, budget.flash, &[]));
        let (step, chain) = budget.deepest(&image, &CONTROL_STEP);
        complaints.extend(check(
            program,
            "the stack of the control step",
            step.into(),
            budget.step_stack.into(),
            &chain,
        ));
        if let Some(limit) = budget.service_stack {
            let (service, chain) = budget.deepest(&image, &SERVICE);
            complaints.extend(check(program, "the stack of the service", service.into(), limit.into(), &chain));
        }
        if let Some(limit) = budget.signature_stack {
            let (signature, chain) = budget.deepest(&image, &SIGNATURE);
            complaints.extend(check(program, "the stack of a signature", signature.into(), limit.into(), &chain));
        }
        if let Some(limit) = budget.ram {
            let (stack, chain) = budget.deepest(&image, &["Reset"]);
            let interrupts: Vec<&str> = budget.interrupts.iter().map(String::as_str).collect();
            let interrupt =
                if interrupts.is_empty() { 0 } else { EXCEPTION_FRAME + budget.deepest(&image, &interrupts).0 };
            let ram = image.ram + u64::from(stack) + u64::from(interrupt);
            println!("{program}: variables {}, stack {stack}, interrupts {interrupt}", image.ram);
            complaints.extend(check(program, "RAM, variables and stack,", ram, limit, &chain));
        }
    }
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
}

#[test]
fn no_panic_can_be_reached_from_the_control_step_and_the_service() {
    for budget in budgets() {
        let image = budget.image();
        // The way there must be known at all: the image itself does panic, in the end.
        assert!(!image.named(PANIC).is_empty(), "{} has no panic handler of that name", budget.program);
        let service = SERVICE.iter().filter(|_| budget.service_stack.is_some());
        let entries = CONTROL_STEP.iter().chain(service).flat_map(|name| image.entry(name));
        let complaints: Vec<String> =
            entries.flat_map(|entry| image.complaints(entry, &|name| name == PANIC)).collect();
        assert!(complaints.is_empty(), "{} can panic:\n{}", budget.program, complaints.join("\n"));
    }
}

#[test]
fn no_panic_can_be_reached_from_the_interrupts() {
    let board = budgets().into_iter().find(|budget| budget.program == "composer-stm32g474").unwrap();
    let image = board.image();
    let entries = INTERRUPTS.iter().flat_map(|name| image.entry(name));
    let complaints: Vec<String> = entries.flat_map(|entry| image.complaints(entry, &|name| name == PANIC)).collect();
    assert!(complaints.is_empty(), "the interrupts can panic:\n{}", complaints.join("\n"));
}

#[test]
fn a_panic_is_found_where_there_is_one() {
    // The benchmark's own loop over frames indexes an array.
    let image = Image::read(&arm::image("composer-qemu-bench", "board-qemu"));
    let complaints = image.complaints(image.entry("main")[0], &|name| name == PANIC);
    assert!(complaints.iter().any(|chain| chain.contains("panic") && chain.ends_with(PANIC)), "{complaints:?}");
    assert!(complaints.iter().any(|chain| chain.ends_with("calls what a register says")), "{complaints:?}");
}
