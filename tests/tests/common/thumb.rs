//! As much of Thumb-2 (ARMv7E-M) as it takes to follow calls and the stack pointer. Encodings are those of the ARMv7-M Architecture
//! Reference Manual, chapter A7.

/// What an instruction does to the flow of control or to the stack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing of either.
    None,
    /// The stack grows by so many bytes.
    Grow(u32),
    /// A call of an address.
    Call(u32),
    /// A jump to an address.
    Jump(u32),
    /// A call or jump to an address in a register.
    Indirect,
    /// The stack pointer becomes something that the instruction alone does not tell.
    UnknownStack,
}

/// The number of halfwords of an instruction that begins so.
pub fn length(first: u16) -> usize {
    if first >= 0xe800 { 2 } else { 1 }
}

/// The effect of the instruction at `address`; `second` counts for instructions of two halfwords.
pub fn effect(address: u32, first: u16, second: u16) -> Effect {
    if length(first) == 1 { narrow(address, first) } else { wide(address, first, second) }
}

/// Where a branch at `address` goes.
fn target(address: u32, offset: i32) -> u32 {
    address.wrapping_add(4).wrapping_add(offset as u32)
}

/// A number of `bits` bits with its sign.
fn signed(value: u32, bits: u32) -> i32 {
    (value << (32 - bits)) as i32 >> (32 - bits)
}

fn narrow(address: u32, i: u16) -> Effect {
    let word = u32::from(i);
    match i {
        // PUSH
        0xb400..=0xb5ff => Effect::Grow(4 * (word & 0x1ff).count_ones()),
        // SUB SP, SP, #imm7
        0xb080..=0xb0ff => Effect::Grow(4 * (word & 0x7f)),
        // BX LR returns.
        0x4770 => Effect::None,
        // BX, BLX, MOV PC
        0x4700..=0x47ff => Effect::Indirect,
        _ if i & 0xff87 == 0x4687 => Effect::Indirect,
        // MOV SP, R7 takes the frame down.
        0x46bd => Effect::None,
        // MOV SP and ADD SP with a register
        _ if i & 0xff87 == 0x4685 || i & 0xff87 == 0x4485 => Effect::UnknownStack,
        // B<c>. Next in line are UDF, which the compiler puts where an enumeration has no value, and SVC.
        0xd000..=0xddff => Effect::Jump(target(address, signed(word & 0xff, 8) * 2)),
        // B
        0xe000..=0xe7ff => Effect::Jump(target(address, signed(word & 0x7ff, 11) * 2)),
        _ => Effect::None,
    }
}

fn wide(address: u32, first: u16, second: u16) -> Effect {
    let (a, b) = (u32::from(first), u32::from(second));
    // Branches
    if first & 0xf800 == 0xf000 && second & 0x8000 != 0 {
        let (s, j1, j2) = (a >> 10 & 1, b >> 13 & 1, b >> 11 & 1);
        if second & 0x1000 != 0 {
            // BL and B.W
            let (i1, i2) = (!(j1 ^ s) & 1, !(j2 ^ s) & 1);
            let to = target(address, signed(s << 23 | i1 << 22 | i2 << 21 | (a & 0x3ff) << 11 | b & 0x7ff, 24) * 2);
            return if second & 0x4000 != 0 { Effect::Call(to) } else { Effect::Jump(to) };
        }
        // Conditions 14 and 15 are MSR, barriers and other system instructions.
        if a >> 6 & 15 < 14 && second & 0x4000 == 0 {
            // B<c>.W
            let offset = signed(s << 19 | j2 << 18 | j1 << 17 | (a & 0x3f) << 11 | b & 0x7ff, 20) * 2;
            return Effect::Jump(target(address, offset));
        }
        return Effect::None;
    }
    let to_stack_pointer = b >> 8 & 15 == 13;
    match first {
        // STMDB SP!
        0xe92d => Effect::Grow(4 * b.count_ones()),
        // STR to [SP, #-imm8]!
        0xf84d if second & 0x0f00 == 0x0d00 => Effect::Grow(b & 0xff),
        // STRD to [SP, #-imm8]!
        0xe96d => Effect::Grow(4 * (b & 0xff)),
        // VPUSH
        0xed2d => Effect::Grow(4 * (b & 0xff)),
        // SUB.W SP, SP, #const
        0xf1ad | 0xf5ad if to_stack_pointer => Effect::Grow(expanded(a >> 10 & 1, b >> 12 & 7, b & 0xff)),
        // SUBW SP, SP, #imm12
        0xf2ad | 0xf6ad if to_stack_pointer => Effect::Grow((a >> 10 & 1) << 11 | (b >> 12 & 7) << 8 | b & 0xff),
        // ADD.W and ADDW to SP from SP take the frame down.
        0xf10d | 0xf50d | 0xf20d | 0xf60d if to_stack_pointer => Effect::None,
        // Other arithmetic on the stack pointer, with a constant or a register
        _ if first & 0xfa00 == 0xf000 && second & 0x8000 == 0 && to_stack_pointer => Effect::UnknownStack,
        _ if first & 0xfe00 == 0xea00 && to_stack_pointer => Effect::UnknownStack,
        // LDR PC: from [SP], #4 it is POP {PC}, from [PC, ...] a jump within the function.
        0xf85d | 0xf8df if b >> 12 == 15 => Effect::None,
        _ if first & 0xff70 == 0xf850 && b >> 12 == 15 => Effect::Indirect,
        _ => Effect::None,
    }
}

/// The "modified immediate constant" (A5.3.2).
fn expanded(i: u32, imm3: u32, imm8: u32) -> u32 {
    match i << 3 | imm3 {
        0 => imm8,
        1 => imm8 << 16 | imm8,
        2 => imm8 << 24 | imm8 << 8,
        3 => imm8 << 24 | imm8 << 16 | imm8 << 8 | imm8,
        high => (0x80 | imm8 & 0x7f).rotate_right(high << 1 | imm8 >> 7),
    }
}

#[test]
fn encodings_are_those_of_the_assembler() {
    // As `llvm-mc -triple=thumbv7em -show-encoding` prints them.
    let cases: [(&str, u16, u16, Effect); 24] = [
        ("push {r4, r5, r6, r7, lr}", 0xb5f0, 0, Effect::Grow(20)),
        ("sub sp, #116", 0xb09d, 0, Effect::Grow(116)),
        ("push.w {r8, r9, r10, r11}", 0xe92d, 0x0f00, Effect::Grow(16)),
        ("str r11, [sp, #-4]!", 0xf84d, 0xbd04, Effect::Grow(4)),
        ("vpush {d8, d9}", 0xed2d, 0x8b04, Effect::Grow(16)),
        ("sub.w sp, sp, #572", 0xf5ad, 0x7d0f, Effect::Grow(572)),
        ("subw sp, sp, #4092", 0xf6ad, 0x7dfc, Effect::Grow(4092)),
        ("add.w sp, sp, #572", 0xf50d, 0x7d0f, Effect::None),
        ("sub.w r4, sp, #572", 0xf5ad, 0x740f, Effect::None),
        ("strd r0, r1, [sp, #-8]!", 0xe96d, 0x0102, Effect::Grow(8)),
        ("mov sp, r4", 0x46a5, 0, Effect::UnknownStack),
        ("sub.w sp, sp, r0", 0xebad, 0x0d00, Effect::UnknownStack),
        ("blx r3", 0x4798, 0, Effect::Indirect),
        ("bx lr", 0x4770, 0, Effect::None),
        ("ldr pc, [r0]", 0xf8d0, 0xf000, Effect::Indirect),
        ("pop {r4, pc}", 0xbd10, 0, Effect::None),
        ("beq #-4", 0xd0fe, 0, Effect::Jump(0x1000)),
        ("b #2044", 0xe3fe, 0, Effect::Jump(0x1800)),
        ("bl #4096", 0xf001, 0xf800, Effect::Call(0x2004)),
        ("b.w #-4096", 0xf7ff, 0xb800, Effect::Jump(0x0004)),
        ("bne.w #1000", 0xf040, 0x81f4, Effect::Jump(0x13ec)),
        ("ldr.w pc, [r0, r1, lsl #2]", 0xf850, 0xf021, Effect::Indirect),
        ("dmb sy", 0xf3bf, 0x8f5f, Effect::None),
        ("udf #254", 0xdefe, 0, Effect::None),
    ];
    for (text, first, second, expected) in cases {
        assert_eq!(effect(0x1000, first, second), expected, "{text}");
    }
}
