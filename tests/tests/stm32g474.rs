//! The images of the board stm32g474, as `cargo image-stm32g474` and its likes link them: what can be seen without the chip.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use composer_firmware::memory_map::FLASH_ADDRESS;
use object::{Object, ObjectSection, ObjectSymbol};

/// Builds the image with one of the aliases of `.cargo/config.toml` and returns where it lies.
fn build(alias: &str) -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo).current_dir(root).arg(alias).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}\nflip-link missing? `cargo install flip-link --locked --version 0.1.12`");
    assert!(!said.contains("warning"), "{said}");
    let image = root.join(composer_host::flash::IMAGE);
    let name = image.file_name().unwrap().to_str().unwrap();
    image.with_file_name(format!("{name}{}", alias.strip_prefix("image-stm32g474").unwrap()))
}

#[test]
fn the_linked_image_fits_the_board() {
    let path = build("image-stm32g474");
    let bytes = std::fs::read(&path).unwrap();
    let elf = object::File::parse(&*bytes).unwrap();
    let symbols: BTreeMap<_, _> = elf.symbols().filter_map(|s| Some((s.name().ok()?, s.address()))).collect();

    // Every byte lies in the region for code; policy and node page are left to `snakectl flash`.
    composer_host::flash::check_image(&path).unwrap();

    // The vectors: initial stack pointer, reset, and the interrupts that this board uses (numbers of RM0440, table 102).
    let vectors = elf.section_by_name(".vector_table").unwrap();
    assert_eq!(vectors.address(), u64::from(FLASH_ADDRESS));
    let vectors: Vec<u64> =
        vectors.data().unwrap().as_chunks().0.iter().map(|w| u64::from(u32::from_le_bytes(*w))).collect();
    let default = symbols["DefaultHandler"] | 1;
    assert_eq!((vectors[0], vectors[1]), (symbols["_stack_start"], symbols["Reset"] | 1));
    for (number, name) in [(18, "ADC1_2"), (21, "FDCAN1_IT0"), (22, "FDCAN1_IT1"), (28, "TIM2")] {
        assert_eq!(vectors[16 + number], symbols[name] | 1, "{name}");
        assert_ne!(vectors[16 + number], default, "{name}");
    }
    assert!(vectors.iter().enumerate().skip(16).filter(|(_, vector)| **vector == default).count() > 90, "all others");

    // flip-link: the stack at the start of the RAM, the variables above it.
    assert!(symbols["_stack_start"] <= symbols["__sdata"]);
    assert!(symbols["_stack_start"] > 0x2000_0000 + 16 * 1024, "not much is left for the stack");

    // The log is formatted on the host: its strings are not in the flash, and nothing here formats a float.
    assert!(elf.section_by_name(".defmt").is_some_and(|section| section.size() > 0));
    let formatting: Vec<_> =
        symbols.keys().filter(|name| name.contains("flt2dec") || name.contains("float_to_")).collect();
    assert!(formatting.is_empty(), "{formatting:?}");
}

#[test]
fn each_peripheral_has_an_image_of_its_own() {
    for (alias, interrupts) in [
        ("image-stm32g474-can", &["FDCAN1_IT0", "FDCAN1_IT1"][..]),
        ("image-stm32g474-encoder", &[]),
        ("image-stm32g474-imu", &[]),
        ("image-stm32g474-motor", &["ADC1_2"]),
    ] {
        let path = build(alias);
        composer_host::flash::check_image(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let elf = object::File::parse(&*bytes).unwrap();
        let symbols: BTreeMap<_, _> = elf.symbols().filter_map(|s| Some((s.name().ok()?, s.address()))).collect();
        assert!(symbols["_stack_start"] <= symbols["__sdata"], "{alias}: flip-link");
        let default = symbols["DefaultHandler"];
        let handled = |name: &str| symbols.get(name).is_some_and(|address| *address != default);
        assert!(interrupts.iter().all(|name| handled(name)), "{alias}");
        // It carries nothing that it does not need: no controller, no network.
        assert!(!symbols.keys().any(|name| name.contains("controller")), "{alias}");
    }
}

/// The board of QEMU's `netduinoplus2` has a Cortex-M4F and the same memory, but none of this chip's peripherals: nothing that the image waits for ever comes,
/// the crystal least of all. What the image does until then is in QEMU's log, under the names of what that board has at these addresses.
#[test]
fn a_dead_crystal_does_not_hang_before_the_watchdog_and_frames_do_not_interrupt_the_current_loops() {
    const WATCHDOG: &str = "I2S2ext: unimplemented device write"; // 0x4000_3000
    const CLOCKS: &str = "GPIOE: unimplemented device"; // 0x4002_1000
    let image = build("image-stm32g474");
    let mut qemu = Command::new("qemu-system-arm")
        .args(["-M", "netduinoplus2", "-nographic", "-monitor", "none", "-serial", "none"])
        .args(["-d", "unimp", "-trace", "nvic_set_prio", "-kernel"])
        .arg(&image)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("qemu-system-arm is installed: ./tests/run does it");
    let mut lines = BufReader::new(qemu.stderr.take().unwrap()).lines().map(Result::unwrap);
    let mut priorities = BTreeMap::new();
    let mut watchdog = Vec::new();
    // Up to the first look at the clocks.
    let first = loop {
        let line = lines.next().expect("the image runs");
        let words: Vec<&str> = line.split_whitespace().collect();
        if line.starts_with(WATCHDOG) {
            watchdog.push(words.last().unwrap().trim_end_matches(')').to_string());
        } else if let ["nvic_set_prio", "NVIC", "set", "irq", number, .., "priority", priority] = words[..] {
            priorities.insert(number.parse::<u32>().unwrap() - 16, priority.parse::<u32>().unwrap());
        } else if line.starts_with(CLOCKS) {
            break line;
        }
    };
    // Unlocked, set, and started (RM0440, 43.4).
    assert_eq!(watchdog.first().map(String::as_str), Some("0x00005555"), "{watchdog:?}");
    assert_eq!(watchdog.last().map(String::as_str), Some("0x0000cccc"), "{watchdog:?}");
    assert_eq!(first, format!("{CLOCKS} read  (size 4, offset 0x000)"));
    // ADC1_2 before TIM2 before both of FDCAN1; less is more urgent.
    let [adc, tim, it0, it1] = [18, 28, 21, 22].map(|number| priorities[&number]);
    assert!(adc < tim && tim < it0 && it0 == it1, "{priorities:?}");

    // HSEON, then looks until patience ends, and then something else: the internal oscillator.
    assert_eq!(lines.next().unwrap(), format!("{CLOCKS} write (size 4, offset 0x000, value 0x00010000)"));
    let looks = lines.by_ref().take_while(|line| line.starts_with(&format!("{CLOCKS} read  (size 4, offset 0x000)")));
    let looks = looks.take(200_000).count();
    assert!((10_000..100_000).contains(&looks), "{looks}");
    qemu.kill().unwrap();
    qemu.wait().unwrap();
}
