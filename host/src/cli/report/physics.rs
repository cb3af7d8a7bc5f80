//! `snakectl report physics`: the open-loop experiments over steps, tolerances and solvers, against a reference that is far finer.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::Result;
use serde_json::{Value, json};

use crate::eval::parallel;
use crate::files::{create_folder, write_whole};
use crate::plot::{Axes, Panel, Series, panels};
use crate::robot::{Robot, Solver};
use crate::sim::open_loop::{Experiment, Outcome};

/// How much finer the reference is than the default step.
const REFERENCE: usize = 32;
/// Its tolerance, and that of the row with a finer one, as a share of the robot's.
const TIGHT: f32 = 0.01;

/// Arguments of `report physics`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Robot file [default: the paper's 8 x 4 links]
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Folder for the table, the figure and the data
    #[arg(long, value_name = "DIR", default_value = "host/results/physics")]
    out: PathBuf,
}

/// A row: its words, its robot, and where it stands on the figure's axis, physics steps a second.
struct Row {
    words: String,
    robot: Robot,
    curve: Option<&'static str>,
}

fn rows(robot: &Robot) -> Vec<Row> {
    let finer = |robot: &Robot, times: f32| Robot { physics_step: robot.physics_step / times, ..robot.clone() };
    let rapier = Robot { solver: Solver::Rapier, ..robot.clone() };
    let step = |robot: &Robot| format!("1/{:.0} s", 1.0 / robot.physics_step);
    let mut rows = Vec::new();
    for times in [0.5, 1.0, 2.0, 4.0, 8.0] {
        let robot = finer(robot, times);
        let default = if times == 1.0 { " (default)" } else { "" };
        rows.push(Row { words: format!("direct, {}{default}", step(&robot)), robot, curve: Some("direct") });
    }
    let tight = Robot { solver_tolerance: TIGHT * robot.solver_tolerance, ..robot.clone() };
    rows.push(Row { words: format!("direct, {}, tolerance / 100", step(robot)), robot: tight, curve: None });
    for times in [1.0, 4.0] {
        let robot = finer(&rapier, times);
        let words = format!(
            "rapier, {} in {} sub-steps, {} iterations",
            step(&robot),
            robot.rapier_substeps,
            robot.rapier_iterations
        );
        rows.push(Row { words, robot, curve: None });
    }
    rows
}

/// Runs the report.
pub fn run(arguments: &Arguments) -> Result<()> {
    let robot = match &arguments.robot {
        Some(path) => Robot::load(path)?,
        None => Robot::default(),
    };
    create_folder(&arguments.out)?;
    let reference = Robot {
        physics_step: robot.physics_step / REFERENCE as f32,
        solver_tolerance: TIGHT * robot.solver_tolerance,
        ..robot.clone()
    };
    let rows = rows(&robot);
    let jobs: Vec<(Experiment, &Robot)> = Experiment::ALL
        .into_iter()
        .flat_map(|e| std::iter::once((e, &reference)).chain(rows.iter().map(move |row| (e, &row.robot))))
        .collect();
    let outcomes = parallel(jobs.len(), crate::cli::cores(), |index| {
        let (experiment, robot) = jobs[index];
        eprintln!("{}, step {} s, {}", experiment.name(), robot.physics_step, robot.solver.name());
        experiment.run(robot)
    });
    let diameter = 2.0 * robot.link_radius;
    let mut table = String::from(
        "| experiment | physics | links off by, units | way of the head, units | penetration, % of a diameter | joint gap, % of a link | energy, off by | sweeps a step |\n|---|---|---|---|---|---|---|---|\n",
    );
    let (mut data, mut figure): (Vec<Value>, Vec<Panel>) = (Vec::new(), Vec::new());
    for (experiment, of_it) in Experiment::ALL.into_iter().zip(outcomes.chunks_exact(rows.len() + 1)) {
        let (truth, found) = (&of_it[0], &of_it[1..]);
        let mut curve = Series { name: "direct".into(), ..Series::default() };
        for (row, outcome) in rows.iter().zip(found) {
            let off = outcome.distance(truth);
            let direct = row.robot.solver == Solver::Direct;
            let sweeps = outcome.effort.sweeps as f64 / outcome.effort.steps.max(1) as f64;
            let energy = outcome.energy / truth.energy - 1.0;
            let only_direct = |text: String| if direct { text } else { "-".into() };
            writeln!(
                table,
                "| {} | {} | {off:.4} | {:.2} | {} | {:.4} | {:+.2} % | {} |",
                experiment.name(),
                row.words,
                way(outcome),
                only_direct(format!("{:.2}", 100.0 * outcome.penetration / diameter)),
                100.0 * outcome.joint_gap / robot.link_length,
                100.0 * energy,
                only_direct(format!("{sweeps:.1}")),
            )?;
            data.push(json!({
                "experiment": experiment.name(), "physics": row.words, "physics_step": row.robot.physics_step,
                "solver": row.robot.solver.name(), "links_off": off, "head": outcome.links[0], "block": outcome.block,
                "penetration": outcome.penetration, "joint_gap": outcome.joint_gap, "energy": outcome.energy,
                "sweeps_a_step": if direct { Some(sweeps) } else { None },
            }));
            if row.curve.is_some() {
                curve.x.push(f64::from(1.0 / row.robot.physics_step).log2());
                curve.mean.push(f64::from(off));
            }
        }
        data.push(json!({
            "experiment": experiment.name(), "physics": "reference", "physics_step": reference.physics_step,
            "head": truth.links[0], "block": truth.block, "energy": truth.energy,
        }));
        figure.push(Panel {
            axes: Axes {
                title: experiment.name().into(),
                y_range: Some((0.0, 0.25)),
                x_label: "log2 of physics steps a second".into(),
                y_label: "links off by, units".into(),
                ..Axes::default()
            },
            series: vec![curve],
        });
    }
    writeln!(
        table,
        "\nRoot mean square distance of the links at the end from a reference with a step of 1/{:.0} s and a hundredth of the tolerance, {} modules. A link is {} units long, {diameter} wide.",
        1.0 / reference.physics_step,
        robot.modules,
        robot.link_length
    )?;
    write_whole(&arguments.out.join("open-loop.json"), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&arguments.out.join("open-loop.md"), table.as_bytes())?;
    write_whole(&arguments.out.join("open-loop.svg"), panels(&figure).as_bytes())?;
    print!("{table}");
    println!("\nwritten to {}", arguments.out.display());
    Ok(())
}

/// How far the head has come.
fn way(outcome: &Outcome) -> f32 {
    let [x, y, _] = outcome.links[0];
    libm::hypotf(x, y)
}
