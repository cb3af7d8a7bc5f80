//! Figures as SVG text: learning curves (mean and standard error over seeds) and attention heat maps.
//!
//! Written by hand because two kinds of figure need no plotting library. Colours are those of Okabe and Ito (2008), which
//! colour-blind readers can tell apart, and viridis for heat maps; the background is white so that a figure reads the same
//! on a light and on a dark page.

use std::fmt::Write;

/// Line colours, by [`Series::colour`]: blue, vermilion, green, purple, orange, sky blue, black.
pub const COLOURS: [&str; 7] = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#222222"];
/// Viridis at nine equidistant values, red, green, blue.
const VIRIDIS: [[f64; 3]; 9] = [
    [68.0, 1.0, 84.0],
    [71.0, 44.0, 122.0],
    [59.0, 81.0, 139.0],
    [44.0, 113.0, 142.0],
    [33.0, 144.0, 141.0],
    [39.0, 173.0, 129.0],
    [92.0, 200.0, 99.0],
    [170.0, 220.0, 50.0],
    [253.0, 231.0, 37.0],
];

/// One curve: a mean with a band of one standard error either way.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// What the legend says.
    pub name: String,
    /// Abscissa, growing.
    pub x: Vec<f64>,
    /// Mean at each x.
    pub mean: Vec<f64>,
    /// Standard error at each x; empty for no band.
    pub se: Vec<f64>,
    /// Index into [`COLOURS`], wrapping round.
    pub colour: usize,
}

/// Title, labels and ranges of a panel. A range of `None` is taken from the data.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axes {
    /// Above the panel.
    pub title: String,
    /// Below the panel.
    pub x_label: String,
    /// At the left of the panel.
    pub y_label: String,
    /// Smallest and largest x.
    pub x_range: Option<(f64, f64)>,
    /// Smallest and largest y.
    pub y_range: Option<(f64, f64)>,
}

/// One panel of a figure.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Panel {
    /// Its axes.
    pub axes: Axes,
    /// Its curves, later ones on top.
    pub series: Vec<Series>,
}

/// A matrix of modules by modules: attention at one time, success with two of them broken.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Heatmap {
    /// Above the matrix, such as "t = 30".
    pub title: String,
    /// Modules: the matrix has that many rows (attending) and columns (attended to).
    pub modules: usize,
    /// Row-major weights, 0 to 1; what is missing or not a number was not measured and is grey.
    pub weights: Vec<f32>,
}

/// What stands around matrices.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MapWords {
    /// Above all of them.
    pub title: String,
    /// What the columns are, and the rows.
    pub columns: String,
    /// See `columns`.
    pub rows: String,
    /// The value at the upper end of the scale; none: the largest there is.
    pub largest: Option<f64>,
}

/// Mean and standard error over runs (seeds), at the points of `grid`, as a curve without a name.
///
/// A run is a list of (x, y) with x growing; between its points it is interpolated linearly. Only points of the grid that
/// every run reaches are kept: a mean over fewer and fewer runs would jump. Points that are not finite are skipped. The
/// standard error is that of the mean (sample standard deviation over the root of the number of runs), 0 for a single run.
pub fn mean_and_se(runs: &[Vec<(f64, f64)>], grid: &[f64]) -> Series {
    let mut series = Series::default();
    for &x in grid {
        let values: Vec<f64> = runs.iter().filter_map(|run| interpolate(run, x)).collect();
        if values.is_empty() || values.len() < runs.len() {
            continue;
        }
        let (mean, se) = mean_and_error(&values);
        series.x.push(x);
        series.mean.push(mean);
        series.se.push(se);
    }
    series
}

/// Mean of some values and its standard error, as in [`mean_and_se`]; not a number if there are none.
pub fn mean_and_error(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (mean, (variance / n).sqrt())
}

fn interpolate(run: &[(f64, f64)], x: f64) -> Option<f64> {
    let mut before: Option<(f64, f64)> = None;
    for &(px, py) in run.iter().filter(|p| p.0.is_finite() && p.1.is_finite()) {
        if px == x {
            return Some(py);
        }
        if px > x {
            return before.map(|(bx, by)| by + (py - by) * (x - bx) / (px - bx));
        }
        before = Some((px, py));
    }
    None
}

/// `count` equidistant points from 0 to the x that every run reaches; empty when a run has no points.
pub fn common_grid(runs: &[Vec<(f64, f64)>], count: usize) -> Vec<f64> {
    let start = runs.iter().filter_map(|r| r.first()).map(|p| p.0).fold(f64::NEG_INFINITY, f64::max);
    let end = runs.iter().map(|r| r.last().map_or(f64::NEG_INFINITY, |p| p.0)).fold(f64::INFINITY, f64::min);
    if !(start.is_finite() && end.is_finite() && end >= start) || count == 0 {
        return Vec::new();
    }
    let step = (end - start) / (count.max(2) - 1) as f64;
    // The last point exactly, so that rounding does not put it behind the end of a run.
    (0..count).map(|i| if i + 1 == count { end } else { start + step * i as f64 }).collect()
}

const WIDTH: f64 = 400.0;
const HEIGHT: f64 = 300.0;
/// Room round the plot area: left, right, top, bottom.
const MARGIN: [f64; 4] = [62.0, 26.0, 34.0, 48.0];

/// Panels side by side, with one legend below for all of them.
pub fn panels(panels: &[Panel]) -> String {
    let mut legend: Vec<(&str, usize)> = Vec::new();
    for s in panels.iter().flat_map(|p| &p.series) {
        let entry = (s.name.as_str(), s.colour % COLOURS.len());
        if !s.name.is_empty() && !legend.contains(&entry) {
            legend.push(entry);
        }
    }
    let width = WIDTH * panels.len().max(1) as f64;
    // Text widths are estimates (7 px a letter): an SVG cannot ask for the font.
    let entry_width =
        |name: &str| 44.0 + name.chars().map(|letter| if letter.is_uppercase() { 9.6 } else { 7.2 }).sum::<f64>();
    let mut rows: Vec<Vec<(&str, usize)>> = Vec::new();
    let mut used = f64::INFINITY;
    for entry in legend {
        if used + entry_width(entry.0) > width - 24.0 {
            rows.push(Vec::new());
            used = 0.0;
        }
        used += entry_width(entry.0);
        if let Some(row) = rows.last_mut() {
            row.push(entry);
        }
    }
    let mut svg = Svg::new(width, HEIGHT + 22.0 * rows.len() as f64 + if rows.is_empty() { 0.0 } else { 6.0 });
    for (i, panel) in panels.iter().enumerate() {
        draw_panel(&mut svg, panel, WIDTH * i as f64, i);
    }
    for (i, row) in rows.iter().enumerate() {
        let y = HEIGHT + 12.0 + 22.0 * i as f64;
        let mut x = (width - row.iter().map(|e| entry_width(e.0)).sum::<f64>()) / 2.0;
        for (name, colour) in row {
            svg.add(format_args!(
                r#"<line x1="{:.1}" y1="{y:.1}" x2="{:.1}" y2="{y:.1}" stroke="{}" stroke-width="3"/>"#,
                x,
                x + 24.0,
                COLOURS[*colour]
            ));
            svg.text(x + 30.0, y + 4.5, "start", "", name);
            x += entry_width(name);
        }
    }
    svg.finish()
}

fn draw_panel(svg: &mut Svg, panel: &Panel, left: f64, index: usize) {
    let [ml, mr, mt, mb] = MARGIN;
    let (x0, x1, y0, y1) = (left + ml, left + WIDTH - mr, HEIGHT - mb, mt);
    let points = |s: &Series| -> Vec<(f64, f64, f64)> {
        let se = |i: usize| s.se.get(i).copied().filter(|v| v.is_finite()).unwrap_or(0.0);
        let all = s.x.iter().zip(&s.mean).enumerate().map(|(i, (x, y))| (*x, *y, se(i)));
        all.filter(|p| p.0.is_finite() && p.1.is_finite()).collect()
    };
    let all: Vec<_> = panel.series.iter().flat_map(points).collect();
    let xr = range(panel.axes.x_range, all.iter().map(|p| p.0));
    let yr = range(panel.axes.y_range, all.iter().flat_map(|p| [p.1 - p.2, p.1 + p.2]));
    let px = |x: f64| x0 + (x - xr.0) / (xr.1 - xr.0) * (x1 - x0);
    let py = |y: f64| y0 + (y - yr.0) / (yr.1 - yr.0) * (y1 - y0);

    svg.text((x0 + x1) / 2.0, 21.0, "middle", r#" font-weight="bold" font-size="14""#, &panel.axes.title);
    for tick in ticks(yr, 5) {
        let y = py(tick);
        svg.add(format_args!(r##"<path d="M{x0:.1} {y:.1}H{x1:.1}" stroke="#e3e6ea"/>"##));
        svg.text(x0 - 7.0, y + 4.5, "end", "", &number(tick));
    }
    for tick in ticks(xr, 5) {
        let x = px(tick);
        svg.add(format_args!(r##"<path d="M{x:.1} {y0:.1}v5" stroke="#555"/>"##));
        svg.text(x, y0 + 19.0, "middle", "", &number(tick));
    }
    let (w, h) = (x1 - x0, y0 - y1);
    svg.add(format_args!(
        r#"<clipPath id="p{index}"><rect x="{x0:.1}" y="{y1:.1}" width="{w:.1}" height="{h:.1}"/></clipPath>"#
    ));
    svg.add(format_args!(r#"<g clip-path="url(#p{index})">"#));
    for s in &panel.series {
        let (colour, points) = (COLOURS[s.colour % COLOURS.len()], points(s));
        if points.is_empty() {
            continue;
        }
        if points.iter().any(|p| p.2 > 0.0) {
            let upper = points.iter().map(|p| (px(p.0), py(p.1 + p.2)));
            let lower = points.iter().rev().map(|p| (px(p.0), py(p.1 - p.2)));
            let d = path(upper.chain(lower));
            svg.add(format_args!(r#"<path d="{d}Z" fill="{colour}" fill-opacity=".18"/>"#));
        }
        let d = path(points.iter().map(|p| (px(p.0), py(p.1))));
        svg.add(format_args!(
            r#"<path d="{d}" fill="none" stroke="{colour}" stroke-width="2.2" stroke-linejoin="round"/>"#
        ));
    }
    svg.add(format_args!("</g>"));
    svg.add(format_args!(r##"<path d="M{x0:.1} {y1:.1}V{y0:.1}H{x1:.1}" fill="none" stroke="#555"/>"##));
    svg.text((x0 + x1) / 2.0, HEIGHT - 9.0, "middle", "", &panel.axes.x_label);
    let (x, y) = (left + 16.0, (y0 + y1) / 2.0);
    svg.text(x, y, "middle", &format!(r#" transform="rotate(-90 {x:.1} {y:.1})""#), &panel.axes.y_label);
}

/// Matrices side by side on one colour scale, as in the paper's attention figure (section IV-D).
pub fn heatmaps(maps: &[Heatmap], words: &MapWords) -> String {
    let (cells, gap, left, top) = (176.0, 26.0, 58.0, 64.0);
    let width = left + maps.len().max(1) as f64 * (cells + gap) + 64.0;
    let height = top + cells + 46.0;
    let mut svg = Svg::new(width, height);
    let weight = |m: &Heatmap, i: usize| m.weights.get(i).filter(|w| w.is_finite()).map(|w| f64::from(*w));
    let largest = maps.iter().flat_map(|m| (0..m.modules * m.modules).filter_map(|i| weight(m, i))).fold(0.0, f64::max);
    let top_value = words.largest.unwrap_or(if largest > 0.0 { largest } else { 1.0 });
    svg.text(width / 2.0, 22.0, "middle", r#" font-weight="bold" font-size="14""#, &words.title);
    for (k, map) in maps.iter().enumerate() {
        let n = map.modules.max(1);
        let (x0, cell) = (left + k as f64 * (cells + gap), cells / n as f64);
        let every = if n <= 12 { 1 } else { n.div_ceil(8) };
        svg.text(x0 + cells / 2.0, top - 12.0, "middle", "", &map.title);
        for i in 0..map.modules {
            for j in 0..map.modules {
                let (x, y) = (x0 + j as f64 * cell, top + i as f64 * cell);
                let weight = weight(map, i * map.modules + j);
                let colour = weight.map_or(NOT_MEASURED.into(), |weight| viridis(weight / top_value));
                // A hair larger than the cell: no seams where renderers smooth edges.
                svg.add(format_args!(
                    r#"<rect x="{x:.2}" y="{y:.2}" width="{0:.2}" height="{0:.2}" fill="{colour}"/>"#,
                    cell + 0.3
                ));
            }
            if i % every == 0 {
                let middle = (i as f64 + 0.5) * cell;
                svg.text(x0 + middle, top + cells + 16.0, "middle", "", &i.to_string());
                if k == 0 {
                    svg.text(x0 - 7.0, top + middle + 4.5, "end", "", &i.to_string());
                }
            }
        }
        svg.text(x0 + cells / 2.0, top + cells + 35.0, "middle", "", &words.columns);
    }
    let (x, y) = (20.0, top + cells / 2.0);
    svg.text(x, y, "middle", &format!(r#" transform="rotate(-90 {x:.1} {y:.1})""#), &words.rows);
    let x = left + maps.len().max(1) as f64 * (cells + gap) - 6.0;
    for i in 0..64 {
        svg.add(format_args!(
            r#"<rect x="{x:.1}" y="{:.2}" width="12" height="{:.2}" fill="{}"/>"#,
            top + cells * f64::from(63 - i) / 64.0,
            cells / 64.0 + 0.3,
            viridis(f64::from(i) / 63.0)
        ));
    }
    svg.text(x + 18.0, top + 9.0, "start", "", &format!("{top_value:.2}"));
    svg.text(x + 18.0, top + cells, "start", "", "0");
    svg.finish()
}

/// A cell of a matrix that nobody measured, no colour of the scale.
const NOT_MEASURED: &str = "#dddddd";

fn viridis(value: f64) -> String {
    let v = value.clamp(0.0, 1.0) * 8.0;
    let i = (v as usize).min(7);
    let c: [u8; 3] =
        std::array::from_fn(|a| (VIRIDIS[i][a] + (VIRIDIS[i + 1][a] - VIRIDIS[i][a]) * (v - i as f64)).round() as u8);
    format!("#{:02x}{:02x}{:02x}", c[0], c[1], c[2])
}

fn path(points: impl Iterator<Item = (f64, f64)>) -> String {
    let mut d = String::new();
    for (x, y) in points {
        // Writing to a string cannot fail.
        let _ = write!(d, "{}{x:.1} {y:.1}", if d.is_empty() { 'M' } else { 'L' });
    }
    d
}

/// The range wanted, or that of the data; never empty.
fn range(wanted: Option<(f64, f64)>, data: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = wanted.unwrap_or_else(|| {
        data.filter(|v| v.is_finite()).fold((f64::INFINITY, f64::NEG_INFINITY), |r, v| (r.0.min(v), r.1.max(v)))
    });
    if !(low.is_finite() && high.is_finite()) {
        (0.0, 1.0)
    } else if high - low < 1e-9 * high.abs().max(1e-3) {
        (low - 0.5 * low.abs().max(1.0), low + 0.5 * low.abs().max(1.0))
    } else {
        (low, high)
    }
}

/// Round numbers within the range, at most `count` steps.
fn ticks((low, high): (f64, f64), count: usize) -> Vec<f64> {
    let rough = (high - low) / count.max(1) as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 2.5, 5.0, 10.0].map(|m| m * power).into_iter().find(|s| *s >= rough * 0.999).unwrap_or(rough);
    let first = (low / step - 1e-6).ceil() as i64;
    let last = (high / step + 1e-6).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

/// A number as short as an axis wants it: 0.25, 40, 250k, 1.5M.
fn number(value: f64) -> String {
    let (scaled, unit) = match value.abs() {
        v if v >= 1e6 => (value / 1e6, "M"),
        v if v >= 1e4 => (value / 1e3, "k"),
        _ => (value, ""),
    };
    let text = format!("{scaled:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    format!("{}{unit}", if text == "-0" { "0" } else { text })
}

struct Svg(String);

impl Svg {
    fn new(width: f64, height: f64) -> Self {
        const FONT: &str = "system-ui, Liberation Sans, Arial, sans-serif";
        let mut svg = Svg(String::new());
        svg.add(format_args!(
            r##"<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0}" height="{height:.0}" font-family="{FONT}"
viewBox="0 0 {width:.0} {height:.0}" font-size="13" fill="#222"><rect width="100%" height="100%" fill="#fff"/>"##
        ));
        svg
    }

    fn add(&mut self, element: std::fmt::Arguments<'_>) {
        // Writing to a string cannot fail.
        let _ = writeln!(self.0, "{element}");
    }

    fn text(&mut self, x: f64, y: f64, anchor: &str, attributes: &str, text: &str) {
        if !text.is_empty() {
            let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
            self.add(format_args!(r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}"{attributes}>{text}</text>"#));
        }
    }

    fn finish(mut self) -> String {
        self.0.push_str("</svg>\n");
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn learning_curves(series: &[Series], axes: &Axes) -> String {
        panels(&[Panel { axes: axes.clone(), series: series.to_vec() }])
    }

    #[test]
    fn mean_and_standard_error_over_runs() {
        let runs = [vec![(0.0, 1.0), (10.0, 3.0)], vec![(0.0, 3.0), (5.0, 4.0), (20.0, 4.0)]];
        let s = mean_and_se(&runs, &[0.0, 5.0, 10.0, 15.0]);
        // 15 is beyond the first run.
        assert_eq!(s.x, [0.0, 5.0, 10.0]);
        assert_eq!(s.mean, [2.0, 3.0, 3.5]);
        // Two values a and b: standard deviation |a-b|/sqrt 2, standard error |a-b|/2.
        for (got, want) in s.se.iter().zip([1.0, 1.0, 0.5]) {
            assert!((got - want).abs() < 1e-12, "{:?}", s.se);
        }
        assert_eq!(mean_and_se(&runs[..1], &[5.0]).se, [0.0]);
        assert!(mean_and_se(&[], &[5.0]).x.is_empty());
        let gap = [vec![(0.0, 0.0), (1.0, f64::NAN), (2.0, 2.0)]];
        assert_eq!(mean_and_se(&gap, &[1.0]).mean, [1.0]);
    }

    #[test]
    fn the_common_grid_ends_where_the_shortest_run_does() {
        let runs = [vec![(0.0, 1.0), (0.3, 3.0)], vec![(0.1, 3.0), (0.7, 4.0)]];
        let grid = common_grid(&runs, 7);
        assert_eq!((grid.len(), grid[0], grid[6]), (7, 0.1, 0.3));
        assert_eq!(mean_and_se(&runs, &grid).x.len(), 7);
        assert!(common_grid(&[vec![], vec![(0.0, 1.0)]], 5).is_empty());
    }

    #[test]
    fn axes_have_round_numbers() {
        assert_eq!(ticks((0.0, 1.0), 5), [0.0, 0.2, 0.4, 0.6000000000000001, 0.8, 1.0]);
        assert_eq!(ticks((0.0, 600_000.0), 5).len(), 4);
        let names: Vec<_> = [0.6000000000000001, 250_000.0, 1.5e6, -0.00000001, 40.0].map(number).into();
        assert_eq!(names, ["0.6", "250k", "1.5M", "0", "40"]);
    }

    #[test]
    fn a_figure_is_well_formed_whatever_the_data() {
        let curve = Series {
            name: "a < b & c".into(),
            x: vec![0.0, 1.0, f64::NAN, 3.0],
            mean: vec![0.5, f64::INFINITY, 1.0, 0.5],
            se: vec![0.1],
            colour: 99,
        };
        let axes = Axes { title: "t".into(), y_range: Some((0.0, 1.0)), ..Axes::default() };
        let empty = Panel::default();
        let same = Panel { series: vec![Series { mean: vec![2.0; 4], ..curve.clone() }], ..Panel::default() };
        let maps = [Heatmap { title: "t = 0".into(), modules: 2, weights: vec![1.0, f32::NAN] }, Heatmap::default()];
        for svg in [
            learning_curves(&[curve], &axes),
            panels(&[empty, same]),
            panels(&[]),
            heatmaps(&maps, &MapWords { title: "goal-reaching".into(), ..MapWords::default() }),
            heatmaps(&[], &MapWords::default()),
        ] {
            assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
            assert_eq!(svg.matches("<text").count(), svg.matches("</text>").count());
            assert!(!svg.contains("a < b"), "text is escaped");
        }
    }

    #[test]
    fn curves_lie_where_the_axes_say() {
        let line = Series { x: vec![0.0, 10.0], mean: vec![0.0, 1.0], ..Series::default() };
        let svg = learning_curves(&[line], &Axes::default());
        let [left, right, top, bottom] = MARGIN;
        let want = format!("M{left:.1} {:.1}L{:.1} {top:.1}", HEIGHT - bottom, WIDTH - right);
        assert!(svg.contains(&want), "{want} in {svg}");
    }

    #[test]
    fn heat_maps_share_one_scale() {
        let maps = [
            Heatmap { title: String::new(), modules: 1, weights: vec![0.25] },
            Heatmap { title: String::new(), modules: 1, weights: vec![0.5] },
        ];
        let svg = heatmaps(&maps, &MapWords::default());
        assert!(svg.contains(&viridis(0.5)) && svg.contains(&viridis(1.0)) && svg.contains("0.50"));
        assert!(!svg.contains(NOT_MEASURED));
        let gaps = [Heatmap { title: String::new(), modules: 2, weights: vec![0.0, f32::NAN, 0.5] }];
        let svg = heatmaps(&gaps, &MapWords::default());
        assert_eq!(svg.matches(NOT_MEASURED).count(), 2, "one is not a number, one is missing");
        assert_eq!((viridis(0.0).as_str(), viridis(1.0).as_str()), ("#440154", "#fde725"));
    }
}
