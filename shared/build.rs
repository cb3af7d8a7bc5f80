//! Sets `cfg(dsp)` where the processor has the DSP extension of ARMv7E-M; Rust's stable `target_feature` does not tell.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(dsp)");
    // Cortex-M4 and M7. On ARMv8-M the extension is optional and the target's name does not say whether it is there.
    if std::env::var("TARGET").is_ok_and(|target| target.starts_with("thumbv7em-")) {
        println!("cargo::rustc-cfg=dsp");
    }
}
