//! A linked image taken apart: its functions, who calls whom, how much stack that takes, and how much memory everything takes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use object::elf::SectionFlags as SectionBits;
use object::{Object, ObjectSection, ObjectSymbol, SectionFlags, SectionKind, SymbolKind, elf};

use crate::thumb::{self, Effect};

/// A function of the image.
#[derive(Debug)]
pub struct Function {
    /// Its name as the source has it.
    pub name: String,
    /// Bytes that it puts on the stack itself: all its pushes and reservations, as if none excluded another.
    pub frame: u32,
    /// Addresses of the functions that it calls or ends with.
    pub calls: BTreeSet<u32>,
    /// Why not all of that is known, if so.
    pub unknown: BTreeSet<&'static str>,
}

/// A linked image.
pub struct Image {
    /// Bytes that lie in flash, initial values of variables included.
    pub flash: u64,
    /// Bytes of RAM for variables.
    pub ram: u64,
    functions: BTreeMap<u32, Function>,
}

/// Name without the hash of the compiler.
fn demangled(name: &str) -> String {
    format!("{:#}", rustc_demangle::demangle(name))
}

impl Image {
    /// Reads an image; it must have its symbols.
    pub fn read(path: &Path) -> Image {
        let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let file = object::File::parse(&*bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let (mut flash, mut ram) = (0, 0);
        for section in file.sections() {
            let SectionFlags::Elf { sh_flags: SectionBits(sh_flags), .. } = section.flags() else {
                panic!("{} is no ELF file", path.display())
            };
            if sh_flags & elf::SHF_ALLOC.0 == 0 {
                continue;
            }
            let (writable, stored) =
                (sh_flags & elf::SHF_WRITE.0 != 0, section.kind() != SectionKind::UninitializedData);
            flash += if stored { section.size() } else { 0 };
            ram += if writable { section.size() } else { 0 };
        }

        // Within a function, `$d` begins data and `$t` code again.
        let mut marks = BTreeMap::new();
        let mut ranges: BTreeMap<u32, (u32, String)> = BTreeMap::new();
        for symbol in file.symbols() {
            let (Ok(name), address) = (symbol.name(), symbol.address() as u32) else { continue };
            match name.as_bytes() {
                [b'$', kind @ (b'd' | b't'), ..] => {
                    marks.insert(address, *kind == b't');
                }
                _ if symbol.kind() == SymbolKind::Text && symbol.is_definition() => {
                    let (start, size) = (address & !1, symbol.size() as u32);
                    let entry = ranges.entry(start).or_insert((size, demangled(name)));
                    entry.0 = entry.0.max(size);
                }
                _ => {}
            }
        }
        let ends: Vec<u32> = ranges.keys().copied().skip(1).collect();
        let mut functions = BTreeMap::new();
        for (i, (&start, (size, name))) in ranges.iter().enumerate() {
            // Functions in assembler may lack a size.
            let next = ends.get(i).copied().unwrap_or(start + 2);
            let end = if *size == 0 { next } else { start + size };
            let section = file.sections().find(|s| (s.address()..s.address() + s.size()).contains(&start.into()));
            let code =
                section.and_then(|s| s.data_range(start.into(), (end - start).into()).ok().flatten()).unwrap_or(&[]);
            functions.insert(start, function(name.clone(), start, code, &marks));
        }
        Image { flash, ram, functions }
    }

    /// The functions of that name: more than one if it is generic.
    pub fn named(&self, name: &str) -> Vec<u32> {
        self.functions.iter().filter(|(_, f)| f.name == name).map(|(address, _)| *address).collect()
    }

    /// The functions of a name that must be there.
    pub fn entry(&self, name: &str) -> Vec<u32> {
        let found = self.named(name);
        assert!(!found.is_empty(), "the image has no function {name}: was it inlined or renamed?");
        found
    }

    /// The function at an address.
    fn at(&self, address: u32) -> Option<&Function> {
        self.functions.get(&(address & !1))
    }

    /// Chains of calls from `entry` to a function that `is_bad` names, or to a place where the chain cannot be followed; functions
    /// that are bad are not entered.
    pub fn complaints(&self, entry: u32, is_bad: &dyn Fn(&str) -> bool) -> Vec<String> {
        let mut came_from = BTreeMap::from([(entry, entry)]);
        let mut open = vec![entry];
        let mut complaints = Vec::new();
        while let Some(address) = open.pop() {
            let chain = || {
                let mut names = Vec::new();
                let mut at = address;
                loop {
                    names.push(self.at(at).map_or("?", |f| &f.name));
                    if at == entry {
                        break;
                    }
                    at = came_from[&at];
                }
                names.reverse();
                names.join(" -> ")
            };
            let Some(function) = self.at(address) else {
                complaints.push(format!("{} goes to {address:#x}, where no function begins", chain()));
                continue;
            };
            if is_bad(&function.name) {
                complaints.push(chain());
                continue;
            }
            complaints.extend(function.unknown.iter().map(|why| format!("{} {why}", chain())));
            for &callee in &function.calls {
                came_from.entry(callee).or_insert_with(|| {
                    open.push(callee);
                    address
                });
            }
        }
        complaints
    }

    /// The most stack that a call of the function at `entry` can take, with the chain of calls that takes it. Functions that `leave_out`
    /// names count nothing. Recursion, and whatever cannot be followed, is an error.
    pub fn stack(&self, entry: u32, leave_out: &dyn Fn(&str) -> bool) -> Result<(u32, Vec<String>), String> {
        let mut known = BTreeMap::new();
        self.deepest(entry, leave_out, &mut Vec::new(), &mut known)?;
        let (mut chain, mut at) = (Vec::new(), Some(entry));
        while let Some(address) = at {
            let function = &self.functions[&address];
            chain.push(format!("{:>6}  {}", function.frame, function.name));
            at = known[&address].1;
        }
        Ok((known[&entry].0, chain))
    }

    fn deepest(
        &self,
        address: u32,
        leave_out: &dyn Fn(&str) -> bool,
        above: &mut Vec<u32>,
        known: &mut BTreeMap<u32, (u32, Option<u32>)>,
    ) -> Result<u32, String> {
        if let Some((depth, _)) = known.get(&address) {
            return Ok(*depth);
        }
        let function = self.at(address).ok_or_else(|| format!("no function begins at {address:#x}"))?;
        if above.contains(&address) {
            return Err(format!("{} calls itself", function.name));
        }
        if let Some(why) = function.unknown.first() {
            return Err(format!("{} {why}", function.name));
        }
        above.push(address);
        let mut most = (0, None);
        for &callee in &function.calls {
            if self.at(callee).is_some_and(|f| leave_out(&f.name)) {
                continue;
            }
            let depth = self.deepest(callee, leave_out, above, known)?;
            if depth > most.0 || most.1.is_none() {
                most = (depth, Some(callee));
            }
        }
        above.pop();
        known.insert(address, (function.frame + most.0, most.1));
        Ok(function.frame + most.0)
    }
}

/// Reads the instructions of a function.
fn function(name: String, start: u32, code: &[u8], marks: &BTreeMap<u32, bool>) -> Function {
    let (mut frame, mut calls, mut unknown) = (0, BTreeSet::new(), BTreeSet::new());
    let halfword = |at: usize| code.get(at..at + 2).map_or(0, |b| u16::from_le_bytes([b[0], b[1]]));
    let end = start + code.len() as u32;
    let mut at = 0;
    while at < code.len() {
        let address = start + at as u32;
        let is_code = marks.range(..=address).next_back().is_none_or(|(_, code)| *code);
        if !is_code {
            at += 2;
            continue;
        }
        let first = halfword(at);
        match thumb::effect(address, first, halfword(at + 2)) {
            Effect::None => {}
            Effect::Grow(bytes) => frame += bytes,
            // Loops and branches
            Effect::Jump(to) if (start..end).contains(&to) => {}
            Effect::Call(to) | Effect::Jump(to) => {
                calls.insert(to);
            }
            Effect::Indirect => {
                unknown.insert("calls what a register says");
            }
            Effect::UnknownStack => {
                unknown.insert("moves the stack pointer by what a register says");
            }
        }
        at += 2 * thumb::length(first);
    }
    Function { name, frame, calls, unknown }
}
