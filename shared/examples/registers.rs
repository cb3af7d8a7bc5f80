//! Prints `firmware/registers.md`.

fn main() {
    let mut text = String::new();
    composer_shared::registers::document(&mut text).expect("a String takes any text");
    print!("{text}");
}
