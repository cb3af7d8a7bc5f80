//! Writes the results: tables, figures, data, and one page with all of it that opens offline.

use std::path::Path;

use anyhow::Result;
use serde_json::json;

use super::gather::{Outcome, Results};
use super::sections::{ROBUST, title};
use crate::files::{create_folder, write_whole};
use crate::methods::Method;
use crate::plot::{Axes, Heatmap, MapWords, Panel, common_grid, heatmaps, mean_and_se, panels};
use crate::recorder::recording;

const PAGE: &str = include_str!("page.html");

/// Methods of the paper's Fig. 4, and of its Fig. 5.
const COMPARED: [Method; 6] = [Method::Composer, Method::Ppo, Method::Mappo, Method::Mat, Method::MatDec, Method::Smp];
/// See [`COMPARED`].
const ABLATED: [Method; 3] = [Method::Composer, Method::ComposerNoImagination, Method::ComposerNoAttention];

/// Learning curves of some methods, a panel a task.
fn curves(results: &Results, methods: &[Method]) -> String {
    let mut figure = Vec::new();
    for &task in &results.comparison.tasks {
        let mut series = Vec::new();
        for (colour, &method) in methods.iter().enumerate() {
            let curves: Vec<_> = results.of(method, task).iter().map(|run| run.curve.clone()).collect();
            if curves.is_empty() {
                continue;
            }
            let mut mean = mean_and_se(&curves, &common_grid(&curves, 11));
            mean.name = title(method).into();
            mean.colour = colour;
            series.push(mean);
        }
        let axes = Axes {
            title: task.title().into(),
            x_label: "environment steps".into(),
            y_label: "success rate".into(),
            x_range: None,
            y_range: Some((0.0, 1.0)),
        };
        figure.push(Panel { axes, series });
    }
    panels(&figure)
}

/// The attention figure of a run, if its modules attended anywhere.
fn attention(run: &Outcome) -> Option<String> {
    let attended = run.attention.as_ref()?;
    let map = |(time, weights): (&f32, &Vec<f32>)| Heatmap {
        title: format!("t = {time:.2} s"),
        modules: attended.modules,
        weights: weights.clone(),
    };
    let maps: Vec<_> = attended.times.iter().zip(&attended.matrices).map(map).collect();
    let words = MapWords {
        title: format!("{}: attention in a successful episode", run.task.0.title()),
        columns: "module attended to".into(),
        rows: "attending module".into(),
        largest: None,
    };
    (!maps.is_empty()).then(|| heatmaps(&maps, &words))
}

/// Which episode of the replay page is of which method and task: their titles and its number.
type Place = (String, String, usize);

/// The replay page with an episode of each method on each task, and which is where.
fn replays(results: &Results) -> Result<Option<(String, Vec<Place>)>> {
    let (mut episodes, mut places) = (Vec::new(), Vec::new());
    let mut add = |name: &str, outcome: &Outcome| {
        if let Some(episode) = &outcome.replay {
            places.push((name.to_string(), outcome.task.0.title().to_string(), episodes.len()));
            episodes.push(episode.clone());
        }
    };
    for method in results.methods() {
        for &task in &results.comparison.tasks {
            if let Some(first) = results.of(method, task).first() {
                add(title(method), first);
            }
        }
    }
    results.robust.iter().for_each(|robust| add(ROBUST, robust));
    if episodes.is_empty() {
        return Ok(None);
    }
    let (env, ..) = super::work::robust(results.comparison.tasks[0])?;
    let page = recording(&env, "The paper's comparison", "float, in the simulator").page_of(&episodes);
    Ok(Some((page, places)))
}

/// Writes everything to the folder `out`: `tables.md`, the figures, `results.json`, and `index.html` with all of it. Returns the tables.
///
/// # Errors
///
/// If a file cannot be written.
pub fn publish(results: &Results, out: &Path) -> Result<String> {
    create_folder(out)?;
    let mut figures = vec![
        ("learning-curves.svg".to_string(), "Learning curves: the paper's Fig. 4", curves(results, &COMPARED)),
        ("ablation.svg".to_string(), "Ablations: the paper's Fig. 5", curves(results, &ABLATED)),
    ];
    for run in &results.runs {
        if let Some(figure) = attention(run) {
            figures.push((format!("attention-{}.svg", run.task.0), "Attention: the paper's Fig. 6", figure));
        }
    }
    let sections = results.sections();
    let tables = sections.iter().map(super::sections::Section::markdown).collect::<Vec<_>>().join("\n");
    let data = json!({
        "episodes_of_a_point": results.episodes,
        "runs_wanted": results.wanted,
        "runs": results.runs,
        "policies_that_ship": results.robust,
    });
    let mut body = String::new();
    let (first, others) = sections.split_at(1);
    body.extend(first.iter().map(super::sections::Section::html));
    for alike in figures.chunk_by(|(_, words, _), (_, next, _)| words == next) {
        body += &format!("<h2>{}</h2>\n", alike[0].1);
        body.extend(alike.iter().map(|(_, _, svg)| format!("<div class=\"wide figure\">{svg}</div>\n")));
    }
    body.extend(others.iter().map(super::sections::Section::html));
    let replays = replays(results)?;
    let script = |value: serde_json::Value| value.to_string().replace('<', "\\u003c");
    let (replay, places) = replays.unwrap_or_default();
    let page = PAGE.replacen("@BODY@", &body, 1).replacen("@PLACES@", &script(json!(places)), 1);
    let page = page.replacen("@REPLAY@", &script(json!(replay)), 1);
    for (name, _, svg) in &figures {
        write_whole(&out.join(name), svg.as_bytes())?;
    }
    write_whole(&out.join("results.json"), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&out.join("tables.md"), tables.as_bytes())?;
    write_whole(&out.join("index.html"), page.as_bytes())?;
    Ok(tables)
}
