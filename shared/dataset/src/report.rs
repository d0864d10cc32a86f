//! Statistics of a dataset, for people: contents, difficulty, and leaks of hidden states.

use std::collections::BTreeMap;
use std::fmt;

use crate::dataset::Dataset;
use crate::equivalence::Equivalence;
use crate::image::Image;
use crate::scenario::{Frame, ScenarioInfo};
use crate::transforms::warning_of_turned;
use carff_messages::Observability;

/// Images that should look the same leak their state if their mean difference exceeds this limit, of 255. People cannot
/// see it, but a network can.
const LEAK_LIMIT: f64 = 0.1;

/// Two branches' images of one view at one time step that both hide the actor's place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HiddenPair {
    /// Camera pose.
    pub view: usize,
    /// Time step of the branches.
    pub timestamp: usize,
    /// The two branches.
    pub branches: [usize; 2],
    /// Mean absolute difference over pixels and channels, 0..=255.
    pub mean_difference: f64,
    /// Largest absolute difference, 0..=255.
    pub max_difference: u8,
}

/// The output of `carff dataset check`.
#[derive(Clone, Debug)]
pub struct DatasetReport {
    /// Folder of the dataset.
    pub dir: String,
    /// Number of images.
    pub frames: usize,
    /// Number of camera poses.
    pub views: usize,
    /// Number of images of each size (width, height), pixels.
    pub image_sizes: BTreeMap<(u32, u32), usize>,
    /// Number of poses of each kind.
    pub view_kinds: BTreeMap<String, usize>,
    /// The scenario.
    pub scenario: Option<ScenarioInfo>,
    /// Number of images per (branch, time step), by observability: full, partial, none, unknown.
    pub counts: BTreeMap<(usize, usize), [usize; 4]>,
    /// PSNR of each pose's mean image against the images, with errors pooled over all poses, decibels. A model that
    /// only knows the pose reaches it. `None` if no pose has two different images.
    pub pose_mean_psnr_db: Option<f64>,
    /// PSNR of the mean image for the bird's-eye view only.
    pub bev_pose_mean_psnr_db: Option<f64>,
    /// Best possible accuracy of naming the state: over all images, and by observability.
    pub ceiling: Option<f64>,
    /// Best possible accuracy for full, partial and none.
    pub ceiling_by_observability: [Option<f64>; 3],
    /// Number of images with masked pixels, and the share of masked pixels in them.
    pub masked: Option<(usize, f64)>,
    /// Pairs of images that should look the same because the actor's place is hidden.
    pub hidden_pairs: Vec<HiddenPair>,
    /// Warnings about unusual values.
    pub warnings: Vec<String>,
}

impl DatasetReport {
    /// Measures a dataset. `images` are those of [`Dataset::load_all_images`].
    pub fn of(dataset: &Dataset, images: &[Image]) -> Self {
        let mut image_sizes = BTreeMap::new();
        for image in images {
            *image_sizes.entry((image.width_px, image.height_px)).or_insert(0) += 1;
        }
        let mut kind_of_view = BTreeMap::new();
        let mut counts: BTreeMap<(usize, usize), [usize; 4]> = BTreeMap::new();
        for frame in dataset.frames() {
            if let (Some(view), Some(kind)) = (frame.view, &frame.view_kind) {
                kind_of_view.insert(view, kind.clone());
            }
            if let (Some(branch), Some(timestamp)) = (frame.branch, frame.timestamp) {
                counts.entry((branch, timestamp)).or_default()[column(frame.observability)] += 1;
            }
        }
        let mut view_kinds = BTreeMap::new();
        for kind in kind_of_view.into_values() {
            *view_kinds.entry(kind).or_insert(0) += 1;
        }
        let bev_view = dataset.scenario().and_then(|s| s.bev_view);
        let equivalence = Equivalence::from_dataset(dataset, images);
        let mut states_of_view: BTreeMap<usize, usize> = BTreeMap::new();
        for view in dataset.frames().iter().filter_map(|frame| frame.view) {
            *states_of_view.entry(view).or_insert(0) += 1;
        }
        // Of a view that is missing in some states, it is unknown which states look the same.
        let is_known = |frame: &&Frame| {
            let count = frame.view.and_then(|view| states_of_view.get(&view));
            frame.alike_states.is_some() || count == Some(&dataset.state_count())
        };
        let pairs_where = |wanted: Option<Observability>| {
            dataset
                .frames()
                .iter()
                .filter(is_known)
                .filter(move |f| wanted.is_none() || f.observability == wanted)
                .filter_map(|f| f.view.zip(f.state))
        };
        let hidden_pairs = hidden_pairs(dataset, images);
        let mut warnings = dataset.warnings().to_vec();
        warnings.extend(warning_of_turned(dataset.dir(), dataset.frames()));
        for pair in hidden_pairs.iter().filter(|p| p.mean_difference > LEAK_LIMIT) {
            warnings.push(format!(
                "view {} at timestamp {}: the actor is hidden, yet branches {} and {} differ by a mean of {:.3} of 255; \
                 a network can learn this difference",
                pair.view, pair.timestamp, pair.branches[0], pair.branches[1], pair.mean_difference
            ));
        }
        Self {
            dir: dataset.dir().display().to_string(),
            frames: dataset.frames().len(),
            views: dataset.view_count(),
            image_sizes,
            view_kinds,
            scenario: dataset.scenario().cloned(),
            counts,
            pose_mean_psnr_db: pose_mean_psnr(dataset, images, None),
            bev_pose_mean_psnr_db: bev_view.and_then(|view| pose_mean_psnr(dataset, images, Some(view))),
            ceiling: equivalence.ceiling(pairs_where(None)),
            ceiling_by_observability: Observability::ALL.map(|o| equivalence.ceiling(pairs_where(Some(o)))),
            masked: masked(dataset),
            hidden_pairs,
            warnings,
        }
    }
}

fn column(observability: Option<Observability>) -> usize {
    match observability {
        Some(Observability::Full) => 0,
        Some(Observability::Partial) => 1,
        Some(Observability::None) => 2,
        None => 3,
    }
}

fn masked(dataset: &Dataset) -> Option<(usize, f64)> {
    let masks: Vec<&[bool]> = (0..dataset.frames().len()).filter_map(|i| dataset.valid_pixels(i)).collect();
    let ignored: usize = masks.iter().map(|mask| mask.iter().filter(|valid| !**valid).count()).sum();
    let all: usize = masks.iter().map(|mask| mask.len()).sum();
    (all > 0).then(|| (masks.len(), ignored as f64 / all as f64))
}

fn pose_mean_psnr(dataset: &Dataset, images: &[Image], only: Option<usize>) -> Option<f64> {
    let mut by_view: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (i, frame) in dataset.frames().iter().enumerate().take(images.len()) {
        if let Some(view) = frame.view.filter(|v| only.is_none_or(|only| only == *v)) {
            by_view.entry(view).or_default().push(i);
        }
    }
    let (mut sum, mut count) = (0.0, 0_usize);
    for of_view in by_view.values().filter(|v| v.len() > 1) {
        let valid = dataset.valid_in_all(of_view);
        let of_view: Vec<&Image> = of_view.iter().map(|&i| &images[i]).collect();
        let size = of_view[0].rgb.len();
        if of_view.iter().any(|image| image.rgb.len() != size) {
            continue;
        }
        let mut mean = vec![0.0_f64; size];
        for image in &of_view {
            mean.iter_mut().zip(&image.rgb).for_each(|(m, v)| *m += f64::from(*v) / of_view.len() as f64);
        }
        for image in &of_view {
            let values = mean.iter().zip(&image.rgb).enumerate().filter(|(i, _)| valid(i / 3));
            sum += values.map(|(_, (m, v))| (m - f64::from(*v)).powi(2)).sum::<f64>();
        }
        count += of_view.len() * 3 * (0..size / 3).filter(|&pixel| valid(pixel)).count();
    }
    (sum > 0.0).then(|| 10.0 * (255.0_f64.powi(2) * count as f64 / sum).log10())
}

fn hidden_pairs(dataset: &Dataset, images: &[Image]) -> Vec<HiddenPair> {
    let mut hidden: BTreeMap<(usize, usize), Vec<(usize, usize)>> = BTreeMap::new();
    for (i, frame) in dataset.frames().iter().enumerate().take(images.len()) {
        if let (Some(view), Some(branch), Some(timestamp), Some(Observability::None)) =
            (frame.view, frame.branch, frame.timestamp, frame.observability)
        {
            hidden.entry((view, timestamp)).or_default().push((branch, i));
        }
    }
    // Without hazard branches, all branches are compared.
    let hazards = dataset.scenario().map_or(&[][..], |s| &s.hazard_branches);
    let alike = |a: usize, b: usize| !hazards.is_empty() && hazards.contains(&a) == hazards.contains(&b);
    let mut pairs = Vec::new();
    for ((view, timestamp), branches) in hidden {
        for (n, &(branch_a, a)) in branches.iter().enumerate() {
            for &(branch_b, b) in &branches[n + 1..] {
                if alike(branch_a, branch_b) || images[a].rgb.len() != images[b].rgb.len() {
                    continue;
                }
                let valid = dataset.valid_in_all(&[a, b]);
                let values = images[a].rgb.iter().zip(&images[b].rgb).enumerate().filter(|(i, _)| valid(i / 3));
                let differences: Vec<u8> = values.map(|(_, (a, b))| a.abs_diff(*b)).collect();
                let sum: u64 = differences.iter().map(|&d| u64::from(d)).sum();
                pairs.push(HiddenPair {
                    view,
                    timestamp,
                    branches: [branch_a, branch_b],
                    mean_difference: sum as f64 / differences.len().max(1) as f64,
                    max_difference: differences.into_iter().max().unwrap_or(0),
                });
            }
        }
    }
    pairs
}

impl fmt::Display for DatasetReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let decibels = |v: Option<f64>| v.map_or_else(|| "-".to_owned(), |v| format!("{v:.2} dB"));
        let percent = |v: Option<f64>| v.map_or_else(|| "-".to_owned(), |v| format!("{:.1} %", v * 100.0));
        writeln!(f, "Dataset     {}", self.dir)?;
        let sizes: Vec<String> = self.image_sizes.iter().map(|((w, h), n)| format!("{n} of {w}x{h} px")).collect();
        writeln!(f, "Images      {} ({})", self.frames, sizes.join(", "))?;
        if let Some((images, share)) = self.masked {
            writeln!(f, "Masks       {images} images; training ignores {} of their pixels", percent(Some(share)))?;
        }
        let kinds: Vec<String> = self.view_kinds.iter().map(|(kind, n)| format!("{n} {kind}")).collect();
        let kinds = if kinds.is_empty() { String::new() } else { format!(" ({})", kinds.join(", ")) };
        writeln!(f, "Poses       {}{kinds}", self.views)?;
        let Some(scenario) = &self.scenario else {
            writeln!(f, "Scenario    none: one state")?;
            return self.fmt_warnings(f);
        };
        writeln!(
            f,
            "Scenario    {}: {} branches x {} timestamps, bird's-eye view {}",
            scenario.name,
            scenario.branches.len(),
            scenario.timestamps,
            scenario.bev_view.map_or_else(|| "not named".to_owned(), |v| v.to_string())
        )?;
        let [low, high] = scenario.bounds;
        writeln!(f, "Bounds      {low:?} to {high:?} m")?;
        let hazards: Vec<&str> =
            scenario.hazard_branches.iter().filter_map(|&b| scenario.branches.get(b)).map(String::as_str).collect();
        writeln!(
            f,
            "Actions     {} in {}, else {}",
            scenario.hazard_action,
            if hazards.is_empty() { "no branch".to_owned() } else { hazards.join(", ") },
            scenario.clear_action
        )?;
        let width = scenario.branches.iter().map(|b| b.chars().count()).max().unwrap_or(0).max(6);
        writeln!(f, "\n{:width$}  {:>4} {:>6} {:>8} {:>6} {:>8}", "branch", "t", "full", "partial", "none", "unknown")?;
        for (&(branch, timestamp), row) in &self.counts {
            let name = scenario.branches.get(branch).map_or("?", String::as_str);
            writeln!(f, "{name:width$}  {timestamp:>4} {:>6} {:>8} {:>6} {:>8}", row[0], row[1], row[2], row[3])?;
        }
        writeln!(f, "\nMean image of each pose: {}", decibels(self.pose_mean_psnr_db))?;
        writeln!(f, "  in the bird's-eye view:  {}", decibels(self.bev_pose_mean_psnr_db))?;
        writeln!(f, "Best possible state accuracy: {}", percent(self.ceiling))?;
        for (o, ceiling) in Observability::ALL.into_iter().zip(self.ceiling_by_observability) {
            writeln!(f, "  {:<8} {:>8}", o.name(), percent(ceiling))?;
        }
        let pairs = self.hidden_pairs.len();
        if pairs == 0 {
            writeln!(f, "Hidden pairs: none")?;
        } else {
            let mean = self.hidden_pairs.iter().map(|p| p.mean_difference).sum::<f64>() / pairs as f64;
            let worst = self.hidden_pairs.iter().map(|p| p.mean_difference).fold(0.0, f64::max);
            let max = self.hidden_pairs.iter().map(|p| p.max_difference).max().unwrap_or(0);
            writeln!(
                f,
                "Hidden pairs: {pairs}, with and without the actor differ by a mean of {mean:.4} of 255 (worst pair \
                 {worst:.4}, worst value {max})"
            )?;
        }
        self.fmt_warnings(f)
    }
}

impl DatasetReport {
    fn fmt_warnings(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for warning in &self.warnings {
            writeln!(f, "warning: {warning}")?;
        }
        Ok(())
    }
}

/// Layout of a contact sheet.
#[derive(Clone, Copy, Debug)]
pub struct SheetOptions {
    /// Maximum number of columns; each is a view.
    pub columns: usize,
    /// Maximum number of rows; each is a state.
    pub max_rows: usize,
    /// Space between images, pixels.
    pub gap_px: u32,
}

impl Default for SheetOptions {
    fn default() -> Self {
        Self { columns: 12, max_rows: 16, gap_px: 2 }
    }
}

/// Border colours of a contact sheet with their meanings: how much of the actor's place an image shows.
const FRAMES: [([u8; 3], &str); 4] = [
    ([40, 160, 60], "actor's place visible (full)"),
    ([230, 190, 30], "partly hidden (partial)"),
    ([205, 50, 45], "hidden (none)"),
    ([128, 128, 128], "unknown"),
];
const BORDER_PX: u32 = 2;

/// A contact sheet, with the texts of its legend.
#[derive(Clone, Debug)]
pub struct ContactSheet {
    /// The images in rows and columns.
    pub image: Image,
    /// Name of each row.
    pub rows: Vec<String>,
    /// Name of each column; empty if the columns have no common view.
    pub columns: Vec<String>,
    /// Distance from one image's left and top edge to those of the next, pixels.
    pub pitch_px: [u32; 2],
    /// Colours of the frames with their meanings; only those in use.
    pub frames: Vec<([u8; 3], &'static str)>,
}

/// Draws a contact sheet: a row per state and a column per view. The views are spread over the kinds of cameras, the
/// bird's-eye view first. Each image's border shows its observability: green full, yellow partial, red none, grey
/// unknown. A dataset without views is shown in the order of its frames.
pub fn contact_sheet(dataset: &Dataset, images: &[Image], options: SheetOptions) -> ContactSheet {
    let (columns, max_rows) = (options.columns.max(1), options.max_rows.max(1));
    let (rows, names, titles) = if dataset.view_count() == 0 {
        let all: Vec<Option<usize>> = (0..images.len()).map(Some).collect();
        let rows: Vec<Vec<_>> = all.chunks(columns).take(max_rows).map(<[_]>::to_vec).collect();
        let first = |row: usize| row * columns;
        let name = |(i, row): (usize, &Vec<_>)| format!("images {} to {}", first(i), first(i) + row.len() - 1);
        let names = rows.iter().enumerate().map(name).collect();
        (rows, names, Vec::new())
    } else {
        let views = spread_views(dataset, columns);
        let states = 0..dataset.state_count().min(max_rows);
        let row = |state| views.iter().map(|&view| dataset.frame_index(state, view)).collect();
        let titles = views.iter().map(|&view| view_name(dataset, view)).collect();
        (states.clone().map(row).collect(), states.map(|state| state_name(dataset, state)).collect(), titles)
    };
    let cell_w = images.iter().map(|i| i.width_px).max().unwrap_or(1) + 2 * BORDER_PX;
    let cell_h = images.iter().map(|i| i.height_px).max().unwrap_or(1) + 2 * BORDER_PX;
    let columns = rows.iter().map(Vec::len).max().unwrap_or(1).max(1) as u32;
    let gap = options.gap_px;
    let mut sheet = Image::filled(
        columns * cell_w + (columns - 1) * gap,
        (rows.len().max(1) as u32) * cell_h + (rows.len().max(1) as u32 - 1) * gap,
        [255; 3],
    );
    let mut is_used = [false; FRAMES.len()];
    for (row, frames) in rows.iter().enumerate() {
        for (at, frame) in frames.iter().enumerate() {
            let Some((frame, image)) = frame.and_then(|f| Some((f, images.get(f)?))) else { continue };
            let kind = column(dataset.frames()[frame].observability);
            is_used[kind] = true;
            let (x, y) = (at as u32 * (cell_w + gap), row as u32 * (cell_h + gap));
            let border = Image::filled(image.width_px + 2 * BORDER_PX, image.height_px + 2 * BORDER_PX, FRAMES[kind].0);
            sheet.paste(&border, x, y);
            sheet.paste(image, x + BORDER_PX, y + BORDER_PX);
        }
    }
    let frames = FRAMES.into_iter().zip(is_used).filter_map(|(frame, used)| used.then_some(frame)).collect();
    ContactSheet { image: sheet, rows: names, columns: titles, pitch_px: [cell_w + gap, cell_h + gap], frames }
}

fn state_name(dataset: &Dataset, state: usize) -> String {
    let branch =
        |s: &ScenarioInfo| Some(format!("{}, t{}", s.branches.get(s.branch_of(state))?, s.timestamp_of(state)));
    dataset.scenario().and_then(branch).unwrap_or_else(|| format!("state {state}"))
}

fn view_name(dataset: &Dataset, view: usize) -> String {
    let kind = dataset.frames().iter().find(|f| f.view == Some(view)).and_then(|f| f.view_kind.as_deref());
    format!("view {view} {}", kind.unwrap_or_default()).trim_end().to_owned()
}

/// Returns representative views: the bird's-eye view, then alternately views of each kind, evenly spaced within the
/// kind.
fn spread_views(dataset: &Dataset, count: usize) -> Vec<usize> {
    let bev = dataset.scenario().and_then(|s| s.bev_view);
    let mut kinds: Vec<(Option<&str>, Vec<usize>)> = Vec::new();
    let mut seen = vec![false; dataset.view_count()];
    for frame in dataset.frames() {
        let Some(view) = frame.view.filter(|v| Some(*v) != bev) else { continue };
        if std::mem::replace(&mut seen[view], true) {
            continue;
        }
        let kind = frame.view_kind.as_deref();
        match kinds.iter_mut().find(|(k, _)| *k == kind) {
            Some((_, views)) => views.push(view),
            None => kinds.push((kind, vec![view])),
        }
    }
    let wanted = count.saturating_sub(bev.iter().count());
    let mut take = vec![0; kinds.len()];
    let mut taken = 0;
    while taken < wanted && kinds.iter().zip(&take).any(|((_, views), &n)| n < views.len()) {
        for ((_, views), n) in kinds.iter().zip(&mut take) {
            if taken < wanted && *n < views.len() {
                *n += 1;
                taken += 1;
            }
        }
    }
    let spread = kinds.iter().zip(take).flat_map(|((_, views), n)| (0..n).map(move |i| views[i * views.len() / n]));
    bev.into_iter().chain(spread).take(count).collect()
}
