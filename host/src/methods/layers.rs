//! Layers with their ways back, over flat f32 numbers: what the networks of the baselines are made of.
//!
//! A [`Tape`] computes at once and notes what it did; [`Tape::backward`] goes through the notes from the last to the first. Every layer is
//! here once forth and once back, side by side, with the gradient written by hand (`of_x`: the gradient of x). The tests compare them with
//! burn's automatic differentiation ([`tensors`](super::tensors)).
//!
//! Each row of a matrix is padded with zeros to a multiple of 16 numbers, a register, so that the products of `kernels.rs`
//! have no ends to care for. What a row becomes does not depend on how many there are.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use super::kernels::{Start, dense, dense_weights, dot, exp_body, gelu, tanh, tanh_and_slope};
use super::layout::{Activation, Layout};
use super::parameters::room;
use super::simd::{Vector, vectorise};

/// Rows are padded to a multiple of this.
const LANES: usize = 16;
/// Rows that go through a product together: what it reads of them more than once stays near.
const TOGETHER: usize = 128;

/// So many numbers with their padding.
fn padded(numbers: usize) -> usize {
    numbers.next_multiple_of(LANES)
}

/// Where an entry of the parameters is: among them, and among those that are packed.
#[derive(Clone, Copy, Debug)]
struct Place {
    rows: usize,
    columns: usize,
    matrix: bool,
    from: usize,
    at: usize,
}

impl Place {
    fn packed(&self) -> Range<usize> {
        self.at..self.at + padded(self.columns) * if self.matrix { padded(self.rows) } else { 1 }
    }
}

/// The parameters of a network, ready for both ways: padded, vectors as they are, matrices with one row an input and with one an output.
#[derive(Clone, Debug, Default)]
pub struct Packed {
    places: HashMap<String, Place>,
    forth: Vec<f32>,
    back: Vec<f32>,
}

impl Packed {
    /// Of these parameters.
    pub fn new(layout: &Layout, parameters: &[f32]) -> Self {
        let (mut places, mut at) = (HashMap::new(), 0);
        for entry in layout.entries() {
            let (rows, columns, matrix, from) = (entry.rows, entry.columns, entry.matrix, entry.offset);
            let place = Place { rows, columns, matrix, from, at };
            at = place.packed().end;
            places.insert(entry.name.clone(), place);
        }
        let mut packed = Self { places, forth: vec![0.0; at], back: vec![0.0; at] };
        packed.load(parameters);
        packed
    }

    /// Takes other parameters.
    pub fn load(&mut self, parameters: &[f32]) {
        for place in self.places.values() {
            let (forth, back) = (&mut self.forth[place.packed()], &mut self.back[place.packed()]);
            let columns = padded(place.columns);
            if !place.matrix {
                forth[..place.columns].copy_from_slice(&parameters[place.from..][..place.columns]);
                continue;
            }
            for row in 0..place.rows {
                let from = &parameters[place.from + row * place.columns..][..place.columns];
                back[row * columns..][..place.columns].copy_from_slice(from);
            }
            each_transposed(place, |from, to| forth[to] = parameters[place.from + from]);
        }
    }

    /// Adds a packed gradient to one in the order of the parameters.
    pub fn unpack(&self, packed: &[f32], to: &mut [f32]) {
        for place in self.places.values() {
            let (packed, to) = (&packed[place.packed()], &mut to[place.from..]);
            if place.matrix {
                each_transposed(place, |from, at| to[from] += packed[at]);
            } else {
                to.iter_mut().zip(&packed[..place.columns]).for_each(|(to, packed)| *to += packed);
            }
        }
    }

    /// Numbers with their padding.
    pub fn len(&self) -> usize {
        self.forth.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.forth.is_empty()
    }

    fn get(&self, name: &str, part: &str) -> Place {
        *self.places.get(&format!("{name}.{part}")).expect("a layer of this network")
    }
}

/// The places of each number of a matrix with one row an output and of the padded one with one row an input, some columns at a time,
/// because those of a whole row would be too far apart for the cache.
fn each_transposed(place: &Place, mut each: impl FnMut(usize, usize)) {
    let rows = padded(place.rows);
    for first in (0..place.columns).step_by(LANES) {
        for row in 0..place.rows {
            for column in first..(first + LANES).min(place.columns) {
                each(row * place.columns + column, column * rows + row);
            }
        }
    }
}

/// A matrix on a [`Tape`].
#[derive(Clone, Copy, Debug)]
pub struct Matrix {
    start: usize,
    rows: usize,
    columns: usize,
    /// Whether a gradient goes through it.
    tracked: bool,
}

impl Matrix {
    /// Some of its rows, in place.
    pub fn rows(self, rows: Range<usize>) -> Self {
        assert!(rows.end <= self.rows);
        Self { start: self.start + rows.start * self.stride(), rows: rows.len(), ..self }
    }

    fn stride(self) -> usize {
        padded(self.columns)
    }

    fn len(self) -> usize {
        self.rows * self.stride()
    }

    fn range(self) -> Range<usize> {
        self.start..self.start + self.len()
    }
}

/// Whom one row of an attention asks: of `n` rows from `first` on, those whose bit is set.
#[derive(Clone, Copy, Debug)]
pub struct Query {
    /// The first row of its team.
    pub first: usize,
    /// Rows of its team.
    pub n: usize,
    /// Bit i stands for row i of the team.
    pub heard: u64,
}

/// Keys and values of an attention whose rows come one after the other.
#[derive(Clone, Debug, Default)]
pub struct Past {
    keys: Vec<f32>,
    values: Vec<f32>,
}

/// A network that a [`Tape`] knows.
#[derive(Clone, Copy, Debug)]
pub struct Network(usize);

/// What a tape has done.
#[derive(Clone, Debug)]
enum Step {
    /// `y = activation(x w + b)`; `slope` is where the activation's is, if that is kept.
    Linear {
        network: Network,
        weight: Place,
        bias: Place,
        activation: Option<Activation>,
        x: Matrix,
        y: Matrix,
        slope: usize,
    },
    /// `y = tanh(x)`; the slopes are kept behind y.
    Tanh { x: Matrix, y: Matrix },
    /// `y = x / |x|`, row by row; the lengths are kept behind y.
    Unit { x: Matrix, y: Matrix },
    /// `y = f x`, a factor for each row.
    Scaled { x: Matrix, factors: Vec<f32>, y: Matrix },
    /// Side by side.
    Beside { parts: Vec<Matrix>, y: Matrix },
    /// One below the other.
    Below { parts: Vec<Matrix>, y: Matrix },
    /// `y = n w + b`, n being x (+ plus) with mean 0 and variance 1 in each row, which is kept behind y; then 1 / standard deviation of each row.
    Norm { network: Network, weight: Place, bias: Place, x: Matrix, plus: Option<Matrix>, y: Matrix },
    /// `y_i = sum_j a_ij v_j`, `a_i = softmax(q_i k_j / sqrt(width))`; a is kept behind y.
    Attention { q: Matrix, k: Matrix, v: Matrix, queries: Arc<[Query]>, y: Matrix },
    /// Row i of y is the part of a row of x that belongs to module i of its team.
    Rows { x: Matrix, teams: Arc<[Query]>, y: Matrix },
}

/// Working memory of a [`Tape`], which grows to what it needs and stays.
#[derive(Clone, Debug, Default)]
pub struct Memory {
    numbers: Vec<f32>,
    gradients: Vec<f32>,
    of_bias: Vec<f32>,
    steps: Vec<Step>,
}

/// Computes with networks and remembers how.
#[derive(Debug)]
pub struct Tape<'a> {
    memory: &'a mut Memory,
    /// Numbers that are taken.
    used: usize,
    networks: Vec<&'a Packed>,
    /// The one network whose parameters gradients are wanted of.
    learning: Option<usize>,
}

impl<'a> Tape<'a> {
    /// An empty one.
    pub fn new(memory: &'a mut Memory) -> Self {
        memory.steps.clear();
        Self { memory, used: 0, networks: Vec::new(), learning: None }
    }

    /// Makes a network known, through which gradients may pass.
    pub fn network(&mut self, weights: &'a Packed) -> Network {
        self.networks.push(weights);
        Network(self.networks.len() - 1)
    }

    /// Makes the network known that learns: gradients of its parameters are wanted.
    pub fn learning(&mut self, weights: &'a Packed) -> Network {
        assert!(self.learning.is_none(), "one network learns at a time");
        let network = self.network(weights);
        self.learning = Some(network.0);
        network
    }

    /// Room for so many numbers, which are not cleared.
    fn take(&mut self, len: usize) -> usize {
        let start = self.used;
        self.used += len;
        room(&mut self.memory.numbers, self.used);
        start
    }

    fn matrix(&mut self, rows: usize, columns: usize, tracked: bool) -> Matrix {
        Matrix { start: self.take(rows * padded(columns)), rows, columns, tracked }
    }

    /// What was there before `y`, `y` itself, and what was taken behind it.
    fn split(&mut self, y: Matrix) -> (&[f32], &mut [f32], &mut [f32]) {
        let (earlier, rest) = self.memory.numbers[..self.used].split_at_mut(y.start);
        let (y, behind) = rest.split_at_mut(y.len());
        (earlier, y, behind)
    }

    fn note(&mut self, y: Matrix, step: Step) -> Matrix {
        if y.tracked {
            self.memory.steps.push(step);
        }
        y
    }

    /// Numbers from outside, `[rows, columns]`.
    pub fn input(&mut self, numbers: &[f32], columns: usize) -> Matrix {
        let y = self.matrix(numbers.len() / columns, columns, false);
        for (y, x) in self.split(y).1.chunks_exact_mut(padded(columns)).zip(numbers.chunks_exact(columns)) {
            y[..columns].copy_from_slice(x);
            y[columns..].fill(0.0);
        }
        y
    }

    /// The numbers of a matrix without its padding, `[rows, columns]`.
    pub fn numbers(&self, x: Matrix) -> Vec<f32> {
        self.memory.numbers[x.range()].chunks_exact(x.stride()).flat_map(|row| &row[..x.columns]).copied().collect()
    }

    /// A linear layer: `x w + b`.
    pub fn linear(&mut self, w: Network, name: &str, x: Matrix) -> Matrix {
        self.layer(w, name, None, x)
    }

    /// A linear layer with an activation behind it.
    pub fn activated(&mut self, w: Network, name: &str, activation: Activation, x: Matrix) -> Matrix {
        self.layer(w, name, Some(activation), x)
    }

    fn layer(&mut self, network: Network, name: &str, activation: Option<Activation>, x: Matrix) -> Matrix {
        let weights = self.networks[network.0];
        let (weight, bias) = (weights.get(name, "weight"), weights.get(name, "bias"));
        assert_eq!(x.columns, weight.columns, "inputs of {name}");
        let y = self.matrix(x.rows, weight.rows, x.tracked || self.learning == Some(network.0));
        let keeps = activation == Some(Activation::Gelu);
        let slope = self.take(if keeps { y.len() } else { 0 });
        let (earlier, of_y, slopes) = self.split(y);
        let x_blocks = earlier[x.range()].chunks(TOGETHER * x.stride());
        for (block, (x_rows, y_rows)) in x_blocks.zip(of_y.chunks_mut(TOGETHER * y.stride())).enumerate() {
            let bias = Start::Bias(&weights.forth[bias.packed()]);
            dense(x_rows, x.stride(), &weights.forth[weight.packed()], bias, y_rows);
            match activation {
                Some(Activation::Gelu) => gelu(y_rows, &mut slopes[block * TOGETHER * y.stride()..][..y_rows.len()]),
                Some(Activation::Tanh) => tanh(y_rows),
                Some(Activation::Relu) => y_rows.iter_mut().for_each(|y| *y = y.max(0.0)),
                None => {}
            }
        }
        self.note(y, Step::Linear { network, weight, bias, activation, x, y, slope })
    }

    /// The hyperbolic tangent of every number, with a slope that is exact however flat it is, which that of [`Tape::activated`] is not.
    pub fn tanh(&mut self, x: Matrix) -> Matrix {
        let y = self.matrix(x.rows, x.columns, x.tracked);
        self.take(y.len());
        let (earlier, of_y, slopes) = self.split(y);
        of_y.copy_from_slice(&earlier[x.range()]);
        tanh_and_slope(of_y, slopes);
        self.note(y, Step::Tanh { x, y })
    }

    /// Every row at unit length.
    pub fn unit(&mut self, x: Matrix) -> Matrix {
        let y = self.matrix(x.rows, x.columns, x.tracked);
        self.take(y.rows);
        let (earlier, of_y, lengths) = self.split(y);
        of_y.copy_from_slice(&earlier[x.range()]);
        to_unit(of_y, lengths);
        self.note(y, Step::Unit { x, y })
    }

    /// Every row times a factor.
    pub fn scaled(&mut self, x: Matrix, factors: Vec<f32>) -> Matrix {
        if factors.iter().all(|factor| *factor == 1.0) {
            return x;
        }
        let y = self.matrix(x.rows, x.columns, x.tracked);
        let (earlier, of_y, _) = self.split(y);
        let rows = earlier[x.range()].chunks_exact(x.stride()).zip(of_y.chunks_exact_mut(x.stride()));
        for ((x, y), factor) in rows.zip(&factors) {
            y.iter_mut().zip(x).for_each(|(y, x)| *y = factor * x);
        }
        self.note(y, Step::Scaled { x, factors, y })
    }

    /// Matrices side by side.
    pub fn beside(&mut self, parts: &[Matrix]) -> Matrix {
        let columns = parts.iter().map(|part| part.columns).sum();
        let y = self.matrix(parts[0].rows, columns, parts.iter().any(|part| part.tracked));
        let (earlier, of_y, _) = self.split(y);
        for (row, y) in of_y.chunks_exact_mut(y.stride()).enumerate() {
            let mut column = 0;
            for part in parts {
                let from = &earlier[part.start + row * part.stride()..][..part.columns];
                y[column..column + part.columns].copy_from_slice(from);
                column += part.columns;
            }
            y[column..].fill(0.0);
        }
        self.note(y, Step::Beside { parts: parts.to_vec(), y })
    }

    /// Matrices one below the other.
    pub fn below(&mut self, parts: &[Matrix]) -> Matrix {
        let rows = parts.iter().map(|part| part.rows).sum();
        let y = self.matrix(rows, parts[0].columns, parts.iter().any(|part| part.tracked));
        let (earlier, mut of_y, _) = self.split(y);
        for part in parts {
            let (to, rest) = of_y.split_at_mut(part.len());
            to.copy_from_slice(&earlier[part.range()]);
            of_y = rest;
        }
        self.note(y, Step::Below { parts: parts.to_vec(), y })
    }

    /// Layer normalisation of each row.
    pub fn norm(&mut self, w: Network, name: &str, x: Matrix) -> Matrix {
        self.norm_of_sum(w, name, x, None)
    }

    /// Layer normalisation of each row of `x + plus`: what closes a residual.
    pub fn residual_norm(&mut self, w: Network, name: &str, x: Matrix, plus: Matrix) -> Matrix {
        self.norm_of_sum(w, name, x, Some(plus))
    }

    fn norm_of_sum(&mut self, network: Network, name: &str, x: Matrix, plus: Option<Matrix>) -> Matrix {
        let weights = self.networks[network.0];
        let (weight, bias) = (weights.get(name, "weight"), weights.get(name, "bias"));
        let tracked = x.tracked || plus.is_some_and(|plus| plus.tracked) || self.learning == Some(network.0);
        let y = self.matrix(x.rows, x.columns, tracked);
        self.take(y.len() + y.rows);
        let (earlier, of_y, behind) = self.split(y);
        let (normal, scales) = behind.split_at_mut(y.len());
        let plus_rows = plus.map_or(&[][..], |plus| &earlier[plus.range()]);
        let [w, b] = [weight, bias].map(|place| &weights.forth[place.packed()]);
        normalise(&earlier[x.range()], plus_rows, x.columns, [w, b], normal, scales, of_y);
        self.note(y, Step::Norm { network, weight, bias, x, plus, y })
    }

    /// Attention with one head: queries from `query`, keys and values from `x`, each a linear layer, and one more over what is gathered
    /// (`NAME.query`, `.key`, `.value`, `.proj`).
    pub fn attention(&mut self, w: Network, name: &str, query: Matrix, x: Matrix, queries: &Arc<[Query]>) -> Matrix {
        let q = self.linear(w, &format!("{name}.query"), query);
        let k = self.linear(w, &format!("{name}.key"), x);
        let v = self.linear(w, &format!("{name}.value"), x);
        let y = self.matrix(q.rows, v.columns, q.tracked || k.tracked);
        self.take(queries.iter().map(|query| query.n).sum());
        let (earlier, of_y, weights) = self.split(y);
        attend(&earlier[q.range()], [&earlier[k.range()], &earlier[v.range()]], q.columns, queries, weights, of_y);
        let y = self.note(y, Step::Attention { q, k, v, queries: queries.clone(), y });
        self.linear(w, &format!("{name}.proj"), y)
    }

    /// The same, without a way back, for some `rows` of a whole that come one after the other: `past` has what earlier ones said.
    pub fn attention_by_rows(
        &mut self,
        w: Network,
        name: &str,
        [query, x]: [Matrix; 2],
        (rows, queries): (&[usize], &[Query]),
        past: &mut Past,
    ) -> Matrix {
        let q = self.linear(w, &format!("{name}.query"), query);
        for (part, kept) in [("key", &mut past.keys), ("value", &mut past.values)] {
            let new = self.linear(w, &format!("{name}.{part}"), x);
            let stride = new.stride();
            for (row, numbers) in rows.iter().zip(self.memory.numbers[new.range()].chunks_exact(stride)) {
                kept.resize(kept.len().max((row + 1) * stride), 0.0);
                kept[row * stride..][..stride].copy_from_slice(numbers);
            }
        }
        let y = self.matrix(q.rows, q.columns, false);
        self.take(queries.iter().map(|query| query.n).sum());
        let (earlier, of_y, weights) = self.split(y);
        attend(&earlier[q.range()], [&past.keys, &past.values], q.columns, queries, weights, of_y);
        self.linear(w, &format!("{name}.proj"), y)
    }

    /// What is one row a team with `columns` numbers for each module, as one row a module; more modules than a team has are left out. `teams` says
    /// of each row of the result which its team's are.
    pub fn rows(&mut self, x: Matrix, columns: usize, teams: &Arc<[Query]>) -> Matrix {
        let y = self.matrix(teams.len(), columns, x.tracked);
        let (earlier, of_y, _) = self.split(y);
        for (y, from) in of_y.chunks_exact_mut(padded(columns)).zip(parts_of_teams(x, columns, teams)) {
            y[..columns].copy_from_slice(&earlier[from..from + columns]);
            y[columns..].fill(0.0);
        }
        self.note(y, Step::Rows { x, teams: teams.clone(), y })
    }

    /// Goes back from the gradients of some matrices, `[rows, columns]` each, and adds those of the parameters of the network that learns to
    /// `sum`, packed.
    pub fn backward(self, of: &[(Matrix, &[f32])], sum: &mut [f32]) {
        let Memory { numbers, gradients, of_bias, steps } = self.memory;
        let gradients = room(gradients, self.used);
        gradients.fill(0.0);
        for (y, of_y) in of {
            let rows = gradients[y.range()].chunks_exact_mut(y.stride()).zip(of_y.chunks_exact(y.columns));
            rows.for_each(|(to, of_y)| add(&mut to[..y.columns], of_y));
        }
        for step in steps.iter().rev() {
            let (Step::Linear { y, .. }
            | Step::Tanh { y, .. }
            | Step::Unit { y, .. }
            | Step::Scaled { y, .. }
            | Step::Beside { y, .. }
            | Step::Below { y, .. }
            | Step::Norm { y, .. }
            | Step::Attention { y, .. }
            | Step::Rows { y, .. }) = step;
            // What a step is made of lies before its result, and what it kept behind.
            let (earlier, of_y) = gradients.split_at_mut(y.start);
            let of_y = &mut of_y[..y.len()];
            let behind = &numbers[y.range().end..];
            match step {
                // of_h = of_y activation'(h);   of_w += x^T of_h;   of_b += sum of_h;   of_x += of_h w^T
                Step::Linear { network, weight, bias, activation, x, y, slope } => {
                    let of_bias = room(of_bias, y.stride());
                    of_bias.fill(0.0);
                    let slopes = if *activation == Some(Activation::Gelu) { *slope } else { y.start };
                    back_to_sums(*activation, of_y, &numbers[slopes..][..y.len()], of_bias);
                    let learns = self.learning == Some(network.0);
                    if learns {
                        add(&mut sum[bias.packed()], of_bias);
                    }
                    let back = &self.networks[network.0].back[weight.packed()];
                    let (x_stride, y_stride) = (TOGETHER * x.stride(), TOGETHER * y.stride());
                    let blocks = numbers[x.range()].chunks(x_stride).zip(of_y.chunks(y_stride));
                    for (block, (x_rows, of_y)) in blocks.enumerate() {
                        if learns {
                            dense_weights(x_rows, x.stride(), of_y, &mut sum[weight.packed()]);
                        }
                        if x.tracked {
                            let of_x = &mut earlier[x.range()][block * x_stride..][..x_rows.len()];
                            dense(of_y, y.stride(), back, Start::Sum, of_x);
                        }
                    }
                }
                Step::Tanh { x, y } => {
                    let slopes = of_y.iter().zip(&behind[..y.len()]);
                    earlier[x.range()].iter_mut().zip(slopes).for_each(|(of_x, (of_y, slope))| *of_x += of_y * slope);
                }
                Step::Unit { x, y } => {
                    to_unit_backward(&numbers[y.range()], &behind[..y.rows], of_y, &mut earlier[x.range()]);
                }
                Step::Scaled { x, factors, y } => {
                    let rows = earlier[x.range()].chunks_exact_mut(y.stride()).zip(of_y.chunks_exact(y.stride()));
                    for ((of_x, of_y), factor) in rows.zip(factors) {
                        of_x.iter_mut().zip(of_y).for_each(|(of_x, of_y)| *of_x += factor * of_y);
                    }
                }
                Step::Beside { parts, y } => {
                    let mut column = 0;
                    for part in parts {
                        for (row, of_y) in of_y.chunks_exact(y.stride()).enumerate().filter(|_| part.tracked) {
                            let of_part = &mut earlier[part.start + row * part.stride()..][..part.columns];
                            add(of_part, &of_y[column..column + part.columns]);
                        }
                        column += part.columns;
                    }
                }
                Step::Below { parts, .. } => {
                    let mut of_y = &*of_y;
                    for part in parts {
                        let (of_part, rest) = of_y.split_at(part.len());
                        if part.tracked {
                            add(&mut earlier[part.range()], of_part);
                        }
                        of_y = rest;
                    }
                }
                Step::Norm { network, weight, bias, x, plus, y } => {
                    let (normal, scales) = behind.split_at(y.len());
                    let w = &self.networks[network.0].forth[weight.packed()];
                    let of_bias = room(of_bias, 2 * y.stride());
                    of_bias.fill(0.0);
                    let (of_w, of_b) = of_bias.split_at_mut(y.stride());
                    normalise_backward(w, y.columns, normal, &scales[..y.rows], of_y, [of_w, of_b]);
                    if self.learning == Some(network.0) {
                        add(&mut sum[weight.packed()], of_w);
                        add(&mut sum[bias.packed()], of_b);
                    }
                    for x in [Some(x), plus.as_ref()].into_iter().flatten().filter(|x| x.tracked) {
                        add(&mut earlier[x.range()], of_y);
                    }
                }
                Step::Attention { q, k, v, queries, .. } => {
                    let (earlier, of_v) = earlier.split_at_mut(v.start);
                    let (earlier, of_k) = earlier.split_at_mut(k.start);
                    let of = [&mut earlier[q.range()], &mut of_k[..k.len()], &mut of_v[..v.len()]];
                    let [q_rows, k_rows, v_rows] = [q, k, v].map(|x| &numbers[x.range()]);
                    attend_backward([q_rows, k_rows, v_rows], q.columns, queries, behind, of_y, of);
                }
                Step::Rows { x, teams, y } => {
                    for (of_y, to) in of_y.chunks_exact(y.stride()).zip(parts_of_teams(*x, y.columns, teams)) {
                        add(&mut earlier[to..to + y.columns], &of_y[..y.columns]);
                    }
                }
            }
        }
    }
}

/// Where among all numbers the part of each row's module begins in its team's row of x.
fn parts_of_teams(x: Matrix, columns: usize, teams: &[Query]) -> impl Iterator<Item = usize> {
    let mut team = 0;
    teams.iter().enumerate().map(move |(row, Query { first, n, .. })| {
        let part = x.start + team * x.stride() + (row - first) * columns;
        team += usize::from(row + 1 == first + n);
        part
    })
}

/// `to += from`
fn add(to: &mut [f32], from: &[f32]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
}

vectorise! {
    /// Turns the gradient of `y = activation(h)` into that of h, and adds its rows up in `of_bias`. `slopes` are y, or GELU's slopes.
    fn back_to_sums(
        activation: Option<Activation>, gradient: &mut [f32], slopes: &[f32], of_bias: &mut [f32]
    ) = back_to_sums_body
}

#[inline(always)]
fn back_to_sums_body<V: Vector>(
    activation: Option<Activation>,
    gradient: &mut [f32],
    slopes: &[f32],
    of_bias: &mut [f32],
) {
    #[inline(always)]
    fn each(gradient: &mut [f32], slopes: &[f32], of_bias: &mut [f32], slope: impl Fn(f32) -> f32) {
        let columns = of_bias.len();
        for (gradient, slopes) in gradient.chunks_exact_mut(columns).zip(slopes.chunks_exact(columns)) {
            for ((gradient, y), of_bias) in gradient.iter_mut().zip(slopes).zip(&mut *of_bias) {
                *gradient *= slope(*y);
                *of_bias += *gradient;
            }
        }
    }
    match activation {
        None => each(gradient, slopes, of_bias, |_| 1.0),
        Some(Activation::Gelu) => each(gradient, slopes, of_bias, |slope| slope),
        Some(Activation::Tanh) => each(gradient, slopes, of_bias, |y| 1.0 - y * y),
        Some(Activation::Relu) => each(gradient, slopes, of_bias, |y| if y > 0.0 { 1.0 } else { 0.0 }),
    }
}

/// The sum of `of` over numbers, in 16 parts.
#[inline(always)]
fn total(numbers: &[f32], others: &[f32], of: impl Fn(f32, f32) -> f32) -> f32 {
    let mut parts = [0.0f32; LANES];
    for (x, y) in numbers.chunks(LANES).zip(others.chunks(LANES)) {
        for ((part, x), y) in parts.iter_mut().zip(x).zip(y) {
            *part += of(*x, *y);
        }
    }
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            parts[i] += parts[i + half];
        }
    }
    parts[0]
}

vectorise! {
    /// Brings rows to unit length: `x /= |x|`, with the length that each had.
    fn to_unit(x: &mut [f32], lengths: &mut [f32]) = to_unit_body
}

#[inline(always)]
fn to_unit_body<V: Vector>(x: &mut [f32], lengths: &mut [f32]) {
    let stride = x.len() / lengths.len();
    for (x, length) in x.chunks_exact_mut(stride).zip(lengths) {
        *length = total(x, x, |x, _| x * x).sqrt().max(1e-12);
        x.iter_mut().for_each(|x| *x /= *length);
    }
}

vectorise! {
    /// The way back of [`to_unit`]: `of_x += (of_y - y (y of_y)) / |x|`, y being the row at unit length.
    fn to_unit_backward(y: &[f32], lengths: &[f32], of_y: &[f32], of_x: &mut [f32]) = to_unit_backward_body
}

#[inline(always)]
fn to_unit_backward_body<V: Vector>(y: &[f32], lengths: &[f32], of_y: &[f32], of_x: &mut [f32]) {
    let stride = y.len() / lengths.len();
    let rows = y.chunks_exact(stride).zip(of_y.chunks_exact(stride)).zip(of_x.chunks_exact_mut(stride));
    for (((y, of_y), of_x), length) in rows.zip(lengths) {
        let along = total(y, of_y, |y, of_y| y * of_y);
        for ((of_x, of_y), y) in of_x.iter_mut().zip(of_y).zip(y) {
            *of_x += (of_y - y * along) / length;
        }
    }
}

vectorise! {
    /// Layer normalisation of the rows of `x + plus`, `plus` empty if there is none: `normal = (x - mean) scale`, `y = normal w + b`.
    fn normalise(
        x: &[f32], plus: &[f32], columns: usize, weights: [&[f32]; 2], normal: &mut [f32], scales: &mut [f32], y: &mut [f32]
    ) = normalise_body
}

#[inline(always)]
fn normalise_body<V: Vector>(
    x: &[f32],
    plus: &[f32],
    columns: usize,
    [w, b]: [&[f32]; 2],
    normal: &mut [f32],
    scales: &mut [f32],
    y: &mut [f32],
) {
    let stride = w.len();
    normal.copy_from_slice(x);
    normal.iter_mut().zip(plus).for_each(|(x, plus)| *x += plus);
    for ((normal, scale), y) in normal.chunks_exact_mut(stride).zip(scales).zip(y.chunks_exact_mut(stride)) {
        let share = 1.0 / columns as f32;
        let real = &normal[..columns];
        let mean = share * total(real, real, |x, _| x);
        let variance = share * total(real, real, |x, _| (x - mean) * (x - mean));
        *scale = 1.0 / (variance + 1e-5).sqrt();
        for (((normal, y), w), b) in normal.iter_mut().zip(y).zip(w).zip(b) {
            *normal = (*normal - mean) * *scale;
            *y = V::scalar(*normal, *w, *b);
        }
    }
}

vectorise! {
    /// The way back of [`normalise`]: turns the gradient of y into that of x, and adds those of w and b up.
    ///
    /// ```text
    /// of_n = w of_y        of_x = scale (of_n - mean(of_n) - n mean(n of_n))
    /// ```
    fn normalise_backward(
        w: &[f32], columns: usize, normal: &[f32], scales: &[f32], gradient: &mut [f32], of_weights: [&mut [f32]; 2]
    ) = normalise_backward_body
}

#[inline(always)]
fn normalise_backward_body<V: Vector>(
    w: &[f32],
    columns: usize,
    normal: &[f32],
    scales: &[f32],
    gradient: &mut [f32],
    [of_w, of_b]: [&mut [f32]; 2],
) {
    let (stride, share) = (w.len(), 1.0 / columns as f32);
    for ((gradient, normal), scale) in gradient.chunks_exact_mut(stride).zip(normal.chunks_exact(stride)).zip(scales) {
        let sums = of_w.iter_mut().zip(&mut *of_b).zip(w);
        for ((g, n), ((of_w, of_b), w)) in gradient.iter_mut().zip(normal).zip(sums) {
            *of_w = V::scalar(*g, *n, *of_w);
            *of_b += *g;
            *g *= w;
        }
        let (gradient, normal) = (&mut gradient[..columns], &normal[..columns]);
        let mean = share * total(gradient, normal, |g, _| g);
        let along = share * total(gradient, normal, |g, n| g * n);
        for (g, n) in gradient.iter_mut().zip(normal) {
            *g = scale * (*g - mean - n * along);
        }
    }
}

vectorise! {
    /// Attention of each query over the rows that it hears: its weights, those of one query behind those of the other, and what they gather.
    fn attend(
        q: &[f32], keys_values: [&[f32]; 2], width: usize, queries: &[Query], weights: &mut [f32], y: &mut [f32]
    ) = attend_body
}

#[inline(always)]
fn attend_body<V: Vector>(
    q: &[f32],
    [k, v]: [&[f32]; 2],
    width: usize,
    queries: &[Query],
    weights: &mut [f32],
    y: &mut [f32],
) {
    assert!(width.is_multiple_of(LANES), "a padded query would be longer than it is");
    let scale = (width as f32).sqrt().recip();
    let mut rest = weights;
    for ((q, y), query) in q.chunks_exact(width).zip(y.chunks_exact_mut(width)).zip(queries) {
        let (weights, others) = rest.split_at_mut(query.n);
        rest = others;
        let team = query.first * width..(query.first + query.n) * width;
        let (k, v) = (&k[team.start..team.end.min(k.len())], &v[team.start..team.end.min(v.len())]);
        let hears = |j: usize| query.heard >> j & 1 == 1;
        let mut largest = f32::NEG_INFINITY;
        weights.fill(f32::NEG_INFINITY);
        for (j, (weight, k)) in weights.iter_mut().zip(k.chunks_exact(width)).enumerate() {
            if hears(j) {
                *weight = dot::<V>(q, k) * scale;
                largest = largest.max(*weight);
            }
        }
        let mut sum = 0.0;
        for (j, weight) in weights.iter_mut().enumerate() {
            let each = exp_body(*weight - largest, V::scalar);
            *weight = if hears(j) { each } else { 0.0 };
            sum += *weight;
        }
        weights.iter_mut().for_each(|weight| *weight /= sum);
        for (column, y) in y.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
            let mut gathered = [0.0; LANES];
            for (weight, v) in weights.iter().zip(v.chunks_exact(width)) {
                let v = &v.as_chunks::<LANES>().0[column];
                for i in 0..LANES {
                    gathered[i] = V::scalar(*weight, v[i], gathered[i]);
                }
            }
            *y = gathered;
        }
    }
}

vectorise! {
    /// The way back of [`attend`]: adds to the gradients of queries, keys and values.
    ///
    /// ```text
    /// of_v_j += a_ij of_y_i        of_s_ij = a_ij (of_y_i v_j - sum_l a_il of_y_i v_l)
    /// of_q_i += scale sum_j of_s_ij k_j        of_k_j += scale of_s_ij q_i
    /// ```
    fn attend_backward(
        latent: [&[f32]; 3], width: usize, queries: &[Query], weights: &[f32], of_y: &[f32], of: [&mut [f32]; 3]
    ) = attend_backward_body
}

#[inline(always)]
fn attend_backward_body<V: Vector>(
    [q, k, v]: [&[f32]; 3],
    width: usize,
    queries: &[Query],
    weights: &[f32],
    of_y: &[f32],
    [of_q, of_k, of_v]: [&mut [f32]; 3],
) {
    /// `to += factor from`
    #[inline(always)]
    fn add_times<V: Vector>(to: &mut [f32], factor: f32, from: &[f32]) {
        for (to, from) in to.as_chunks_mut::<LANES>().0.iter_mut().zip(from.as_chunks::<LANES>().0) {
            for i in 0..LANES {
                to[i] = V::scalar(factor, from[i], to[i]);
            }
        }
    }
    let scale = (width as f32).sqrt().recip();
    let mut rest = weights;
    let rows = q.chunks_exact(width).zip(of_q.chunks_exact_mut(width)).zip(of_y.chunks_exact(width));
    for (((q, of_q), of_y), query) in rows.zip(queries) {
        let (weights, others) = rest.split_at(query.n);
        rest = others;
        let heard = |j: &usize| query.heard >> j & 1 == 1;
        let at = |j: usize| (query.first + j) * width..(query.first + j + 1) * width;
        let mut of_weights = [0.0f32; u64::BITS as usize];
        let mut mean = 0.0;
        for j in (0..query.n).filter(heard) {
            of_weights[j] = dot::<V>(of_y, &v[at(j)]);
            mean = V::scalar(weights[j], of_weights[j], mean);
            add_times::<V>(&mut of_v[at(j)], weights[j], of_y);
        }
        for j in (0..query.n).filter(heard) {
            let of_score = scale * weights[j] * (of_weights[j] - mean);
            add_times::<V>(of_q, of_score, &k[at(j)]);
            add_times::<V>(&mut of_k[at(j)], of_score, q);
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Tensor;

    use super::super::layout::Scheme;
    use super::super::random::numbers;
    use super::super::tensors::{Weights, floats};
    use super::*;

    fn near(what: &str, found: &[f32], expected: &[f32]) {
        assert_eq!(found.len(), expected.len());
        let largest = expected.iter().fold(1.0f32, |a, b| a.max(b.abs()));
        for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
            assert!((found - expected).abs() < 2e-5 * largest, "{what} {i}: {found} instead of {expected}");
        }
    }

    /// The same by a tape and by burn: output, and gradients of parameters and input for random gradients of the output. The input goes
    /// through a linear layer first, so that there is one of it.
    fn compare(
        what: &str,
        layout: impl Fn(&mut Layout),
        [rows, inputs]: [usize; 2],
        taped: impl Fn(&mut Tape, Network, Matrix) -> Matrix,
        burns: impl Fn(&Weights, Tensor<2>) -> Tensor<2>,
    ) {
        let mut all = Layout::default();
        all.linear("door", 7, inputs, Scheme::Uniform);
        layout(&mut all);
        let parameters: Vec<f32> = numbers(all.len(), 1).iter().map(|x| 0.4 * x).collect();
        let input = numbers(rows * 7, 2);

        let (packed, mut memory) = (Packed::new(&all, &parameters), Memory::default());
        // What an earlier tape left behind does not matter.
        memory.numbers = vec![f32::NAN; 1 << 16];
        let mut t = Tape::new(&mut memory);
        let w = t.learning(&packed);
        let x = t.input(&input, 7);
        let x = t.linear(w, "door", x);
        let y = taped(&mut t, w, x);
        let found = t.numbers(y);
        let of_y = numbers(found.len(), 3);
        let (mut sum, mut gradient) = (vec![0.0; packed.len()], vec![0.0; all.len()]);
        t.backward(&[(y, &of_y)], &mut sum);
        packed.unpack(&sum, &mut gradient);

        let w = Weights::tracked(&all, &parameters);
        let y = burns(&w, w.linear("door", w.tensor(&input, [rows, 7])));
        near(what, &found, &floats(y.clone().inner()));
        let shape = y.dims();
        let loss = (y * w.tensor(&of_y, shape)).sum();
        let expected = w.gradients(&all, &loss);
        for entry in all.entries() {
            near(&format!("{what}, {}", entry.name), &gradient[entry.range()], &expected[entry.range()]);
        }
    }

    #[test]
    fn linear_layers_and_activations_are_burns() {
        for (rows, inputs, outputs) in [(1, 3, 1), (5, 40, 64), (300, 66, 30)] {
            let layout = |layout: &mut Layout| layout.linear("a", inputs, outputs, Scheme::Uniform);
            let linear = |t: &mut Tape, w, x| t.linear(w, "a", x);
            compare("linear", layout, [rows, inputs], linear, |w, x| w.linear("a", x));
            for activation in [Activation::Tanh, Activation::Relu, Activation::Gelu] {
                let taped = |t: &mut Tape, w, x| t.activated(w, "a", activation, x);
                compare("activated", layout, [rows, inputs], taped, |w, x| activation.apply(w.linear("a", x)));
            }
        }
    }

    #[test]
    fn what_joins_and_scales_rows_is_burns() {
        let layout = |layout: &mut Layout| layout.linear("a", 20, 5, Scheme::Uniform);
        let factors = [0.0, 1.0, 0.5, 1.0];
        let taped = |t: &mut Tape, w, x: Matrix| {
            let x = t.unit(x);
            let x = t.tanh(x);
            let y = t.linear(w, "a", x);
            let x = t.beside(&[x, y]);
            let first = t.scaled(x.rows(0..4), factors.to_vec());
            t.below(&[x.rows(2..6), first])
        };
        compare("joined", layout, [6, 20], taped, |w, x| {
            let length = (x.clone() * x.clone()).sum_dim(1).sqrt();
            let x = (x / length).tanh();
            let x = Tensor::cat(vec![x.clone(), w.linear("a", x)], 1);
            let first = x.clone().narrow(0, 0, 4) * w.tensor(&factors, [4, 1]);
            Tensor::cat(vec![x.narrow(0, 2, 4), first], 0)
        });
    }

    #[test]
    fn normalisation_and_its_residual_are_burns() {
        for columns in [3, 40, 64] {
            let layout = |layout: &mut Layout| {
                layout.layer_norm("a", columns);
                layout.linear("b", columns, columns, Scheme::Uniform);
            };
            let taped = |t: &mut Tape, w, x| t.norm(w, "a", x);
            compare("norm", layout, [9, columns], taped, |w, x| w.layer_norm("a", x));
            let taped = |t: &mut Tape, w, x| {
                let plus = t.linear(w, "b", x);
                t.residual_norm(w, "a", x, plus)
            };
            compare("residual", layout, [9, columns], taped, |w, x| w.layer_norm("a", x.clone() + w.linear("b", x)));
        }
    }

    #[test]
    fn attention_is_burns_whoever_is_heard() {
        let (teams, modules, width) = (3, 5, 32);
        let layout = |layout: &mut Layout| {
            for part in ["a.query", "a.key", "a.value", "a.proj", "other"] {
                layout.linear(part, width, width, Scheme::Uniform);
            }
        };
        let heard = |i: usize| (0b10110u64 >> (i % 3)) & 31 | 1 << (i % modules);
        let queries: Arc<[Query]> =
            (0..teams * modules).map(|i| Query { first: i / modules * modules, n: modules, heard: heard(i) }).collect();
        let mask: Vec<f32> = (0..teams * modules * modules)
            .map(|i| if heard(i / modules) >> (i % modules) & 1 == 1 { 0.0 } else { -1e9 })
            .collect();
        let taped = |t: &mut Tape, w, x| {
            let query = t.linear(w, "other", x);
            t.attention(w, "a", query, x, &queries)
        };
        compare("attention", layout, [teams * modules, width], taped, |w, x| {
            let mask = w.tensor(&mask, [teams, modules, modules]);
            w.attention("a", w.linear("other", x.clone()), x, mask)
        });
    }

    #[test]
    fn rows_of_modules_are_parts_of_rows_of_teams() {
        // Teams of three and one, in rows with room for four.
        let (columns, outputs) = (3, 12);
        let layout = |layout: &mut Layout| layout.linear("a", 5, outputs, Scheme::Uniform);
        let query = |first, n| Query { first, n, heard: 0 };
        let teams: Arc<[Query]> = [query(0, 3), query(0, 3), query(0, 3), query(3, 1)].into();
        let taped = |t: &mut Tape, w, x| {
            let all = t.linear(w, "a", x);
            t.rows(all, columns, &teams)
        };
        compare("rows", layout, [2, 5], taped, |w, x| {
            let all = w.linear("a", x).reshape([8, columns]);
            Tensor::cat(vec![all.clone().narrow(0, 0, 3), all.narrow(0, 4, 1)], 0)
        });
    }

    #[test]
    fn gradients_pass_through_a_network_that_does_not_learn() {
        let mut layout = Layout::default();
        layout.linear("a", 6, 3, Scheme::Uniform);
        let [first, second] = [4, 5].map(|seed| numbers(layout.len(), seed));
        let mut other = Layout::default();
        other.linear("b", 3, 2, Scheme::Uniform);
        let second = &second[..other.len()];
        let (learns, passes) = (Packed::new(&layout, &first), Packed::new(&other, second));
        let (mut memory, mut sum, mut gradient) = (Memory::default(), vec![0.0; learns.len()], vec![0.0; layout.len()]);
        let mut t = Tape::new(&mut memory);
        let (a, b) = (t.learning(&learns), t.network(&passes));
        let x = t.input(&[1.0; 6], 6);
        let y = t.linear(a, "a", x);
        let y = t.linear(b, "b", y);
        t.backward(&[(y, &[1.0, 0.0])], &mut sum);
        learns.unpack(&sum, &mut gradient);
        // Of each output of the first, the weight that the second gives it.
        for (i, of) in gradient[18..].iter().enumerate() {
            assert_eq!(*of, second[i]);
            assert!(gradient[i * 6..(i + 1) * 6].iter().all(|g| g == of));
        }
    }
}
