//! The results in words and tables, once for the page and once as Markdown.

use composer_shared::policy::Task;

use super::gather::{Outcome, Results};
use super::measure::{Cell, FAULTS, LENGTHS, LOST, Point, TABLED};
use super::tune::Tuned;
use super::{protocol, published};
use crate::methods::Method;
use crate::plot::mean_and_error;
use crate::stats::{paired, with_interval};

/// A table with its heading and what there is to say about it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Section {
    /// Heading.
    pub title: String,
    /// Sentences above the table.
    pub text: Vec<String>,
    /// Heads of the columns; none without a table.
    pub head: Vec<String>,
    /// Rows.
    pub rows: Vec<Vec<String>>,
}

impl Section {
    /// As Markdown.
    pub fn markdown(&self) -> String {
        let mut text = format!("## {}\n\n{}\n", self.title, self.text.join("\n\n"));
        if !self.head.is_empty() {
            let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
            text += &format!("\n{}|{}\n", line(&self.head), "---|".repeat(self.head.len()));
            text.extend(self.rows.iter().map(|row| line(row)));
        }
        text
    }

    /// As HTML.
    pub fn html(&self) -> String {
        let escape = |text: &str| text.replace('&', "&amp;").replace('<', "&lt;");
        let mut html = format!("<h2>{}</h2>\n", escape(&self.title));
        html.extend(self.text.iter().map(|sentence| format!("<p>{}</p>\n", escape(sentence))));
        if !self.head.is_empty() {
            let line = |cells: &[String], tag: &str| {
                let cells: String = cells.iter().map(|cell| format!("<{tag}>{}</{tag}>", escape(cell))).collect();
                format!("<tr>{cells}</tr>\n")
            };
            let rows: String = self.rows.iter().map(|row| line(row, "td")).collect();
            html += &format!(
                "<div class=\"wide\"><table>\n<thead>{}</thead>\n<tbody>{rows}</tbody></table></div>\n",
                line(&self.head, "th")
            );
        }
        html
    }
}

/// A method as tables and figures call it.
pub fn title(method: Method) -> &'static str {
    match method {
        Method::Composer => "COMPOSER",
        Method::ComposerNoImagination => "COMPOSER without imagination",
        Method::ComposerNoAttention => "COMPOSER without attention",
        Method::ComposerNeither => "COMPOSER with neither",
        Method::Ppo => "PPO, zero-padded",
        Method::Mappo => "MAPPO",
        Method::Mat => "MAT",
        Method::MatDec => "MAT_dec",
        Method::Smp => "SMP",
    }
}

/// What the policies that ship are called.
pub const ROBUST: &str = "the policy that ships, trained otherwise";
/// What stands where nothing has been measured.
const NONE: &str = "-";

/// Order of the rows: the paper's method first, then the baselines as the paper names them, the ablations last.
pub const ORDER: [Method; 8] = [
    Method::Composer,
    Method::Ppo,
    Method::Mappo,
    Method::Mat,
    Method::MatDec,
    Method::Smp,
    Method::ComposerNoImagination,
    Method::ComposerNoAttention,
];

fn healthy() -> Point {
    Point { fault: "none", modules: 8, bus: false }
}

impl Results {
    /// The runs of a method on a task with its own settings, by their seeds.
    pub fn of(&self, method: Method, task: Task) -> Vec<&Outcome> {
        self.having(method, task, false)
    }

    fn having(&self, method: Method, task: Task, tuned: bool) -> Vec<&Outcome> {
        let wanted = |run: &&Outcome| run.method == method.name() && run.task.0 == task && run.tuned == tuned;
        self.runs.iter().filter(wanted).collect()
    }

    /// The methods compared of which there are runs, in the order of the tables.
    pub fn methods(&self) -> Vec<Method> {
        ORDER.into_iter().filter(|method| self.runs.iter().any(|run| run.method == method.name())).collect()
    }

    /// The others, which have none yet.
    fn missing(&self) -> Vec<Method> {
        let missing = |method: &Method| self.comparison.methods.contains(method) && !self.methods().contains(method);
        ORDER.into_iter().filter(missing).collect()
    }

    fn baselines(&self) -> Vec<Method> {
        self.methods().into_iter().filter(|method| !Method::COMPOSERS.contains(method)).collect()
    }

    fn values(&self, method: Method, task: Task, point: Point, of: fn(&Cell) -> f64) -> Vec<f64> {
        self.of(method, task).iter().filter_map(|run| run.cell(point)).map(of).collect()
    }

    /// Mean and standard error over the seeds that are there; how many, if not all.
    fn spread(&self, method: Method, task: Task, point: Point, of: fn(&Cell) -> f64, digits: usize) -> String {
        spread(&self.values(method, task, point, of), digits, self.comparison.seeds.len())
    }

    /// COMPOSER's success minus that of another method for every (task, seed) that both have.
    fn differences(&self, other: Method, tasks: &[Task]) -> Vec<f64> {
        let mut differences = Vec::new();
        for &task in tasks {
            for ours in self.of(Method::Composer, task) {
                let theirs = self.of(other, task).into_iter().find(|run| run.seed == ours.seed);
                let success = |run: &Outcome| run.cell(healthy()).map(|cell| cell.success_rate);
                let both = success(ours).zip(theirs.and_then(success));
                differences.extend(both.map(|(ours, theirs)| ours - theirs));
            }
        }
        differences
    }

    /// Everything there is to say, in order.
    pub fn sections(&self) -> Vec<Section> {
        let mut sections = vec![self.protocol(), self.success(), self.ahead(), self.by_task(), self.slopes()];
        if self.comparison.tasks.contains(&TABLED) {
            let faults: Vec<_> =
                FAULTS.iter().map(|(fault, words)| (Point { fault, ..healthy() }, (*words).to_string())).collect();
            let lengths: Vec<_> = LENGTHS
                .iter()
                .map(|&modules| (Point { modules, ..healthy() }, format!("{modules} modules ({} links)", 4 * modules)))
                .collect();
            let trained = "trained on eight healthy modules";
            sections.push(self.table(
                &format!("Table II: broken modules, {}, {trained}", TABLED.title()),
                &faults,
                false,
            ));
            sections.push(self.table(
                &format!("Table III: other lengths, {}, {trained}", TABLED.title()),
                &lengths,
                false,
            ));
            sections.push(self.table("Table II as integer controllers on the bus", &faults, true));
            sections.push(self.table("Table III as integer controllers on the bus", &lengths, true));
        }
        sections.push(self.bus());
        sections.extend(self.imagination());
        sections.extend(self.comparison.tuned.as_ref().map(|tuned| self.tuned(tuned)));
        sections
    }

    fn protocol(&self) -> Section {
        let missing = self.wanted - self.runs.len();
        let mut text = vec![format!(
            "{} of {} runs are done{}. Every policy is trained on eight healthy modules, for the same environment steps ({}; Block Pushing twice \
             as many) and on the same reward, each method with its authors' settings; success is that of {} published episodes for each run, without \
             exploration, as mean and standard error over the seeds {}.",
            self.runs.len(),
            self.wanted,
            if missing > 0 { format!("; the {missing} others are left out") } else { String::new() },
            thousands(self.comparison.steps.unwrap_or(protocol::STEPS)),
            self.episodes,
            self.comparison.seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(", "),
        )];
        let missing: Vec<_> = self.missing().into_iter().map(title).collect();
        if !missing.is_empty() {
            text.push(format!("Of {} there is no run yet.", missing.join(" and ")));
        }
        if self.methods().contains(&Method::Smp) {
            text.push(format!(
                "SMP was given {} updates for each environment step and hidden layers of {} and {}; its authors give it 1, and 400 and 300.",
                protocol::SMP_UPDATES_PER_STEP, protocol::SMP_WIDTHS[0], protocol::SMP_WIDTHS[1]
            ));
        }
        if !self.comparison.settings.is_empty() {
            text.push(format!("Not the protocol's settings: {}.", self.comparison.settings.join(", ")));
        }
        Section { title: "The paper's comparison".into(), text, ..Section::default() }
    }

    fn success(&self) -> Section {
        let tasks = &self.comparison.tasks;
        let head = std::iter::once("success".into()).chain(tasks.iter().map(|task| task.title().into())).collect();
        let mut rows: Vec<Vec<String>> = Vec::new();
        for method in self.methods() {
            let cells = tasks.iter().map(|task| self.spread(method, *task, healthy(), |c| c.success_rate, 2));
            rows.push(std::iter::once(title(method).into()).chain(cells).collect());
        }
        rows.push(self.robust_row(tasks, healthy()));
        Section {
            title: "Success, eight healthy modules".into(),
            text: vec![
                "The last row is apart: the policies of `snakectl report policies`, trained with faults and for longer, as integers in the simulator; \
                 the interval is that of their episodes (Wilson)."
                    .into(),
            ],
            head,
            rows,
        }
    }

    /// The policies that ship, with the interval of their episodes: they are one policy a task.
    fn robust_row(&self, tasks: &[Task], point: Point) -> Vec<String> {
        let of = |task: &Task| {
            let cell = self.robust.iter().find(|robust| robust.task.0 == *task).and_then(|robust| robust.cell(point));
            cell.map_or(NONE.into(), |c| with_interval(c.success_rate, c.success_low, c.success_high, 2))
        };
        std::iter::once(ROBUST.into()).chain(tasks.iter().map(of)).collect()
    }

    fn ahead(&self) -> Section {
        let mut rows = Vec::new();
        for method in self.methods().into_iter().filter(|method| *method != Method::Composer) {
            let differences = self.differences(method, &self.comparison.tasks);
            let ahead = differences.iter().filter(|d| **d > 0.0).count();
            rows.push(vec![
                title(method).into(),
                with_half_width(paired(&differences)),
                format!("{ahead} of {}", differences.len()),
            ]);
        }
        Section {
            title: "COMPOSER's success minus that of the others".into(),
            text: vec![
                "Differences of runs of the same task and seed on the same episodes, all tasks together: mean and 95 % interval (Student)."
                    .into(),
            ],
            head: ["COMPOSER minus", "mean", "ahead in"].map(Into::into).to_vec(),
            rows,
        }
    }

    /// The methods that have runs of a task with their mean success, the best first.
    fn ranked(&self, task: Task, methods: &[Method]) -> Vec<(Method, f64)> {
        let mean = |method: &Method| {
            let values = self.values(*method, task, healthy(), |c| c.success_rate);
            (!values.is_empty()).then(|| (*method, mean_and_error(&values).0))
        };
        let mut ranked: Vec<_> = methods.iter().filter_map(mean).collect();
        ranked.sort_by(|a, b| b.1.total_cmp(&a.1));
        ranked
    }

    fn by_task(&self) -> Section {
        let mut rows = Vec::new();
        for &task in &self.comparison.tasks {
            let baselines = self.ranked(task, &self.baselines());
            let all = self.ranked(task, &[self.baselines(), vec![Method::Composer]].concat());
            let (Some((best, _)), Some((first, _))) = (baselines.first(), all.first()) else { continue };
            // PPO decides for all modules in one place.
            let modular = baselines.iter().find(|(method, _)| *method != Method::Ppo).map(|(method, _)| *method);
            let yes = |is: bool| if is { "yes" } else { "no" }.to_string();
            let compared = |method: Method, is: bool| match self.of(method, task).is_empty() {
                true => NONE.to_string(),
                false => yes(is),
            };
            let order: Vec<String> = all.iter().map(|(method, mean)| format!("{} {mean:.2}", title(*method))).collect();
            rows.push(vec![
                task.title().into(),
                title(*best).into(),
                with_half_width(paired(&self.differences(*best, &[task]))),
                order.join(", "),
                compared(Method::Composer, *first == Method::Composer),
                compared(Method::Mappo, modular == Some(Method::Mappo)),
                compared(Method::Smp, all.last().is_some_and(|(last, _)| *last == Method::Smp)),
            ]);
        }
        let head = [
            "task",
            "best baseline",
            "COMPOSER minus it",
            "best first",
            "COMPOSER first",
            "MAPPO the best of the modular baselines",
            "SMP last",
        ];
        Section {
            title: "Each task".into(),
            text: vec![
                "The last three columns are what the paper says of its Fig. 4; differences are of the same seed, with a 95 % interval that so few \
                 seeds make wide."
                    .into(),
            ],
            head: head.map(Into::into).to_vec(),
            rows,
        }
    }

    fn slopes(&self) -> Section {
        let tasks = &self.comparison.tasks;
        let mut rows = Vec::new();
        for method in self.methods() {
            let of = |task: &Task| {
                let slopes: Vec<f64> =
                    self.of(method, *task).iter().filter_map(|run| run.end).map(|line| line.slope).collect();
                if slopes.is_empty() { NONE.into() } else { spread_signed(&slopes) }
            };
            rows.push(std::iter::once(title(method).into()).chain(tasks.iter().map(of)).collect());
        }
        Section {
            title: "Slope at the end".into(),
            text: vec![
                "By how much the success of the training's own episodes, with their noise, still rose in 100,000 steps, over the last fifth of each run."
                    .into(),
            ],
            head: std::iter::once("slope".into()).chain(tasks.iter().map(|task| task.title().into())).collect(),
            rows,
        }
    }

    fn table(&self, heading: &str, points: &[(Point, String)], bus: bool) -> Section {
        let columns = ["success", "distance, units", "steps"];
        let mut head = vec![String::from("method")];
        for (_, words) in points {
            head.extend(columns.iter().map(|column| format!("{words}: {column}")));
        }
        let mut rows = Vec::new();
        for method in self.methods() {
            let runs = self.of(method, TABLED);
            if bus && runs.iter().all(|run| run.not_on_the_bus.is_some()) {
                continue;
            }
            let mut row = vec![title(method).to_string()];
            for (point, _) in points {
                let point = Point { bus, ..*point };
                row.push(self.spread(method, TABLED, point, |c| c.success_rate, 2));
                row.push(self.spread(method, TABLED, point, |c| c.distance, 2));
                row.push(self.spread(method, TABLED, point, |c| c.steps, 1));
            }
            rows.push(row);
            if !bus && published::numbers(method, points[0].0).is_some() {
                let mut row = vec![format!("{}, the paper's", title(method))];
                for (point, _) in points {
                    let numbers = published::numbers(method, *point).into_iter().flatten();
                    row.extend(numbers.zip([2, 2, 1]).map(|((mean, se), d)| format!("{mean:.d$} +- {se:.d$}")));
                }
                rows.push(row);
            }
        }
        let mut row = vec![ROBUST.to_string()];
        let robust = self.robust.iter().find(|robust| robust.task.0 == TABLED);
        for (point, _) in points {
            let cell = robust.and_then(|robust| robust.cell(Point { bus, ..*point }));
            let of = |text: &dyn Fn(&Cell) -> String| cell.map_or(NONE.to_string(), text);
            row.push(of(&|c| with_interval(c.success_rate, c.success_low, c.success_high, 2)));
            row.push(of(&|c| format!("{:.2}", c.distance)));
            row.push(of(&|c| format!("{:.1}", c.steps)));
        }
        rows.push(row);
        let text = if bus {
            format!(
                "The same policies frozen to integers, a complete controller in every module, on a CAN-FD bus that loses {:.0} % of the frames at every \
                 receiver. A blind module acts on zeros, there as in the simulator and in the paper, and says so; a board relaxes it unless told otherwise.",
                100.0 * LOST
            )
        } else {
            "Success, distance of the head from the goal at the end, and control steps, with the paper's numbers below. The paper's cap is 125 steps at \
             every length; ours grows with the snake beyond eight modules."
                .into()
        };
        Section { title: heading.into(), text: vec![text], head, rows }
    }

    fn tuned(&self, tuned: &Tuned) -> Section {
        let methods = self.methods();
        let there = |task: &&Task| methods.iter().any(|method| tuned.of(**task, *method).is_some());
        let tasks: Vec<Task> = self.comparison.tasks.iter().filter(there).copied().collect();
        let mut rows = Vec::new();
        for &method in &methods {
            let of = |task: &Task| {
                let settings = tuned.of(*task, method)?;
                let runs = self.having(method, *task, !settings.is_empty());
                let cells = runs.iter().filter_map(|run| run.cell(healthy()));
                let success: Vec<f64> = cells.map(|cell| cell.success_rate).collect();
                let settings = if settings.is_empty() { "its own".into() } else { settings.join(", ") };
                Some(format!("{}; {settings}", spread(&success, 2, self.comparison.seeds.len())))
            };
            let cells: Vec<_> = tasks.iter().map(of).collect();
            if cells.iter().any(Option::is_some) {
                let cells = cells.into_iter().map(|cell| cell.unwrap_or_else(|| "-".into()));
                rows.push(std::iter::once(title(method).into()).chain(cells).collect());
            }
        }
        Section {
            title: "With settings tuned equally".into(),
            text: vec![format!(
                "Every method here had {} trials on each of these tasks, of half the steps each, with seeds that are used for nothing else; the best settings were \
                 trained anew with the seeds of the comparison. Success on eight healthy modules, and the settings.",
                tuned.trials
            )],
            head: std::iter::once("tuned".into()).chain(tasks.iter().map(|task| task.title().into())).collect(),
            rows,
        }
    }

    /// What the imagination policies came to; none without any.
    fn imagination(&self) -> Option<Section> {
        let mut rows = Vec::new();
        for &task in &self.comparison.tasks {
            let imagined: Vec<[f64; 2]> =
                self.of(Method::Composer, task).iter().filter_map(|run| run.imagined).collect();
            if !imagined.is_empty() {
                let column = |k: usize| {
                    spread(&imagined.iter().map(|of| of[k]).collect::<Vec<_>>(), 3, self.comparison.seeds.len())
                };
                rows.push(vec![task.title().into(), column(0), column(1)]);
            }
        }
        let bound = crate::methods::imagination::ImaginationConfig::default().bound;
        (!rows.is_empty()).then(|| Section {
            title: "What is imagined".into(),
            text: vec![format!(
                "COMPOSER's imagination policies in the last tenth of training, in units a control step: the imagined step is at most {bound} long; the \
                 imagined modules come nearer to where the task wants them by the first number, and the real ones are away from the imagined ones by the second."
            )],
            head: ["task", "comes nearer by", "missed by the modules by"].map(Into::into).to_vec(),
            rows,
        })
    }

    fn bus(&self) -> Section {
        let mut rows = Vec::new();
        let mut text = vec![format!(
            "Success as integers on the bus that loses {:.0} % of the frames minus success as floats in the simulator, same policies and episodes: mean over \
             the seeds and 95 % interval.",
            100.0 * LOST
        )];
        let tasks = &self.comparison.tasks;
        let learnt: Vec<_> = self.methods().into_iter().filter(|method| method.acts_alone()).map(title).collect();
        if !learnt.is_empty() {
            text.push(format!(
                "The image of a module has no room for layers that are normalised: what goes onto the bus of {} is a network of COMPOSER's form without attention \
                 that has learnt what theirs does (host/src/distil.rs), so the difference has that in it, too.",
                learnt.join(" and ")
            ));
        }
        for method in self.methods() {
            let runs: Vec<_> = self.runs.iter().filter(|run| run.method == method.name() && !run.tuned).collect();
            if let Some(why) = runs.iter().find_map(|run| run.not_on_the_bus.clone()) {
                text.push(format!("Not on the bus: {why}."));
                continue;
            }
            let of = |task: &Task| {
                let difference = |run: &&Outcome| {
                    let on_bus = run.cell(Point { bus: true, ..healthy() })?;
                    Some(on_bus.success_rate - run.cell(healthy())?.success_rate)
                };
                let differences: Vec<f64> = self.of(method, *task).iter().filter_map(difference).collect();
                with_half_width(paired(&differences))
            };
            rows.push(std::iter::once(title(method).into()).chain(tasks.iter().map(of)).collect());
        }
        Section {
            title: "What integers and lost frames cost".into(),
            text,
            head: std::iter::once("bus minus simulator".into())
                .chain(tasks.iter().map(|task| task.title().into()))
                .collect(),
            rows,
        }
    }
}

/// Mean and standard error; how many values there are, if not `wanted`.
fn spread(values: &[f64], digits: usize, wanted: usize) -> String {
    let (mean, se) = mean_and_error(values);
    let note = if values.len() < wanted { format!(" ({} of {wanted})", values.len()) } else { String::new() };
    match values.len() {
        0 => NONE.into(),
        1 => format!("{mean:.digits$}{note}"),
        _ => format!("{mean:.digits$} +- {se:.digits$}{note}"),
    }
}

/// Mean and standard error of numbers whose sign matters.
fn spread_signed(values: &[f64]) -> String {
    let (mean, se) = mean_and_error(values);
    if values.len() > 1 { format!("{mean:+.3} +- {se:.3}") } else { format!("{mean:+.3}") }
}

/// A mean difference with its interval.
fn with_half_width(difference: Option<(f64, Option<f64>)>) -> String {
    match difference {
        None => NONE.into(),
        Some((mean, None)) => format!("{mean:+.2}"),
        Some((mean, Some(half))) => format!("{mean:+.2} [{:+.2}, {:+.2}]", mean - half, mean + half),
    }
}

/// A whole number with a comma after each three digits.
fn thousands(number: u64) -> String {
    let digits = number.to_string();
    let first = (digits.len() - 1) % 3 + 1;
    let (head, tail) = digits.split_at(first);
    let groups = tail.as_bytes().chunks(3).map(|group| format!(",{}", String::from_utf8_lossy(group)));
    std::iter::once(head.to_string()).chain(groups).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        assert_eq!([0, 999, 1000, 12_345_678].map(thousands), ["0", "999", "1,000", "12,345,678"]);
        assert_eq!(spread(&[0.5, 0.7, 0.6], 2, 3), "0.60 +- 0.06");
        assert_eq!((spread(&[0.5], 2, 3), spread(&[], 2, 3)), ("0.50 (1 of 3)".into(), "-".into()));
        assert_eq!(with_half_width(paired(&[0.1, 0.3])), "+0.20 [-1.07, +1.47]");
    }

    #[test]
    fn a_section_is_the_same_on_the_page_and_in_markdown() {
        let section = Section {
            title: "A < B".into(),
            text: vec!["Yes.".into()],
            head: vec!["a".into(), "b".into()],
            rows: vec![vec!["1".into(), "<2".into()]],
        };
        assert_eq!(section.markdown(), "## A < B\n\nYes.\n\n| a | b |\n|---|---|\n| 1 | <2 |\n");
        assert!(section.html().contains("<td>1</td><td>&lt;2</td>") && section.html().contains("<h2>A &lt; B</h2>"));
    }
}
