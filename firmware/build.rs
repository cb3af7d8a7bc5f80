//! Gives the image of a board its memory layout (`boards/BOARD.x`) and linker scripts, and the controller the fingerprint of its sources.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::{env, fs};

#[path = "src/memory_map.rs"]
mod memory_map;

fn main() {
    println!("cargo::rerun-if-changed=boards");
    fingerprint();
    let boards = ["qemu", "stm32g474"];
    let chosen = boards
        .into_iter()
        .filter(|board| env::var_os(format!("CARGO_FEATURE_BOARD_{}", board.to_uppercase())).is_some());
    let chosen: Vec<_> = chosen.collect();
    let board = match &chosen[..] {
        [] => return,
        [board] => board,
        several => panic!("choose one board, not {}", several.join(" and ")),
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::copy(format!("boards/{board}.x"), out.join("memory.x")).expect("the board's memory layout can be copied");
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rustc-link-arg-bins=--nmagic");
    println!("cargo::rustc-link-arg-bins=-Tlink.x");
    if *board == "stm32g474" {
        println!("cargo::rustc-link-arg-bins=-Tdefmt.x");
        // `boards/stm32g474.x` is held against these when the image is linked.
        let map = [
            ("_flash_address", memory_map::FLASH_ADDRESS),
            ("_flash_size", memory_map::FLASH_SIZE),
            ("_policy_address", memory_map::POLICY_ADDRESS),
            ("_policy_size", memory_map::POLICY_SIZE),
            ("_records_address", memory_map::RECORDS_ADDRESS),
            ("_storage_address", memory_map::STORAGE_ADDRESS),
            ("_storage_size", memory_map::STORAGE_SIZE),
            ("_node_page_address", memory_map::NODE_PAGE_ADDRESS),
        ];
        for (name, value) in map {
            println!("cargo::rustc-link-arg-bins=--defsym={name}={value:#x}");
        }
    }
}

/// What the libraries of the controller are built from, boards apart, as one number: a simulator and an image that differ in it
/// run different controllers (`link::BUILD`).
fn fingerprint() {
    let mut files = Vec::new();
    for folder in ["src", "../shared/src"] {
        println!("cargo::rerun-if-changed={folder}");
        sources(Path::new(folder), &mut files);
    }
    files.sort();
    let mut hasher = DefaultHasher::new();
    for file in &files {
        file.hash(&mut hasher);
        fs::read(file).expect("the sources can be read").hash(&mut hasher);
    }
    println!("cargo::rustc-env=COMPOSER_CONTROLLER_SOURCES={:016x}", hasher.finish());
}

fn sources(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("the sources can be listed") {
        let path = entry.expect("the sources can be listed").path();
        if path.is_dir() {
            if !path.ends_with("src/bin") && !path.ends_with("tests") {
                sources(&path, files);
            }
        } else if path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs") {
            files.push(path);
        }
    }
}
