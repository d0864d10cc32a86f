//! The page's tables of the field's images.

use super::markdown::{db, head, row};
use crate::{FieldImages, ImageTable, PairMeans};
use std::fmt::Write;

/// Writes the tables of the field's images.
pub fn images(page: &mut String, table: &ImageTable) {
    let _ = writeln!(page, "## Images of the field\n");
    if let Some(toggled) = &table.toggled {
        let _ = writeln!(
            page,
            "PSNR from above, in dB, of each rendered state (row) against every true state (column). *Matching* is the \
             diagonal; *un-matching* is the rest, without pairs of states that look the same from above.\n\n### Known \
             states, toggled\n\nRendered with the latent of the state: {} renderings.\n",
            toggled.renderings
        );
        matrix(page, &table.states, toggled);
        means(page, toggled, table.mean_image_db);
    }
    if let Some(predicted) = &table.predicted {
        let _ = writeln!(
            page,
            "### Forecast states\n\nRendered with latents drawn from the forecast of the previous step, from \
             unambiguous images of trained poses: {} renderings. Missing rows are first steps, which are never \
             forecast.\n",
            predicted.renderings
        );
        matrix(page, &table.states, predicted);
        means(page, predicted, table.mean_image_db);
    } else if table.toggled.is_some() {
        let _ = writeln!(
            page,
            "No forecast states: no forecast in the checkpoint, or no unambiguous image of a state with a next step.\n"
        );
    }
    if !table.novel_views.is_empty() {
        let _ = writeln!(
            page,
            "### Dataset poses\n\nThe field from the poses of the dataset, with the latent of the state. Its \
             training did not use the held-out poses. The mean image of a pose over all states is made of true images: \
             it has the background, but no state. Where little changes, the possible gain is small. On held-out poses, \
             the mean image uses data that the field never had.\n"
        );
        head(page, &["poses", "images", "PSNR, dB", "mean image, dB", "gain, dB", "SSIM", "inside the actors, dB"]);
        for (part, v) in table.novel_views.iter() {
            row(
                page,
                &[
                    part.into(),
                    v.images.to_string(),
                    db(Some(v.psnr_db)),
                    db(Some(v.mean_image_db)),
                    format!("{:+.1}", v.gain_db),
                    format!("{:.3}", v.ssim),
                    db(v.actor_db),
                ],
            );
        }
        page.push('\n');
    }
}

fn matrix(page: &mut String, states: &[String], table: &FieldImages) {
    let mut cells = vec!["rendered \\ true"];
    cells.extend(states.iter().map(String::as_str));
    head(page, &cells);
    for (r, values) in table.psnr_db.iter().enumerate() {
        let Some(values) = values else { continue };
        let value = |(t, v): (usize, &f64)| if r == t { format!("**{v:.1}**") } else { format!("{v:.1}") };
        let mut cells = vec![states.get(r).cloned().unwrap_or_default()];
        cells.extend(values.iter().enumerate().map(value));
        row(page, &cells);
    }
    page.push('\n');
}

fn means(page: &mut String, table: &FieldImages, mean_image_db: Option<f64>) {
    head(page, &["branch", "matching, dB", "un-matching, dB", "difference, dB"]);
    let mut line = |name: &str, m: &PairMeans| {
        row(page, &[name.into(), db(m.matching_db), db(m.unmatching_db), db(m.margin_db)]);
    };
    for (branch, m) in &table.by_branch {
        line(branch, m);
    }
    line("all", &table.all);
    let gain = table.all.matching_db.zip(mean_image_db).map(|(a, b)| format!("{:+.1}", a - b));
    let _ = writeln!(
        page,
        "\nMatching pairs: SSIM {}, {} dB inside the dynamic actors' pixels, {} dB over the pixels that change among \
         states; {} dB over the mean image of all states, which has {} dB.\n",
        table.ssim.map_or_else(|| "-".into(), |s| format!("{s:.3}")),
        db(table.actor_db),
        db(table.changed_db),
        gain.unwrap_or_else(|| "-".into()),
        db(mean_image_db)
    );
}
