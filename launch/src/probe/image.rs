//! `carff probe image`: pictures to files, or into the terminal.

use super::file_in;
use super::session::{Session, SessionArgs, colours};
use anyhow::{Context, bail, ensure};
use carff_messages::{ViewKind, ViewMeta};
use carff_observe::{Received, TopicId};
use clap::Args;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::PathBuf;

/// Widest picture in a terminal, columns.
const MAX_COLUMNS: u32 = 80;

/// Show pictures.
#[derive(Clone, Debug, Args)]
pub struct ImageArgs {
    /// The topic: `camera/frame` or `renderer/view`.
    pub topic: TopicId,
    /// Folder for PNG files; without it pictures go into the terminal.
    #[arg(short, long)]
    pub out: Option<PathBuf>,
    /// Stop after so many pictures.
    #[arg(long)]
    pub count: Option<u64>,
    /// Which run, and for how long.
    #[command(flatten)]
    pub session: SessionArgs,
}

pub(super) fn run(args: &ImageArgs) -> anyhow::Result<()> {
    ensure!(
        matches!(args.topic, TopicId::Frame | TopicId::View),
        "topic `{}` has no pictures: look at `{}` or `{}`",
        args.topic,
        TopicId::Frame,
        TopicId::View
    );
    ensure!(args.out.is_some() || colours(), "this is no terminal with colours: give a folder for PNG files with -o");
    let mut session = Session::open(&args.session, "probe-image")?;
    session.listen([args.topic])?;
    let mut shown = 0;
    let going = session.follow(
        |_, message| {
            let (name, width_px, height_px, rgb) = match message {
                Received::Frame(p) => {
                    let meta = p.meta();
                    (format!("frame-{:06}", meta.header.frame_id), meta.width_px, meta.height_px, p.bytes())
                }
                Received::View(p) => (view_name(p.meta()), p.meta().width_px, p.meta().height_px, p.bytes()),
                _ => bail!("no picture"),
            };
            if let Some(folder) = &args.out {
                let path = file_in(folder, &format!("{name}.png"))?;
                image::save_buffer(&path, rgb, width_px, height_px, image::ColorType::Rgb8)
                    .with_context(|| format!("cannot write {}", path.display()))?;
                println!("{}", path.display());
            } else {
                println!("{}{name}", in_blocks(rgb, width_px, height_px));
                let _ = std::io::stdout().flush();
            }
            shown += 1;
            Ok(args.count.is_none_or(|count| shown < count))
        },
        || Ok(()),
    )?;
    session.say_end(going);
    Ok(())
}

/// What a rendered view is called: frame, step, hypothesis, camera.
pub(crate) fn view_name(meta: &ViewMeta) -> String {
    let kind = ViewKind::try_from(meta.kind).map_or("view", ViewKind::name);
    format!("view-{:06}-step{}-{:02}-{kind}", meta.header.frame_id, meta.header.step, meta.hypothesis)
}

/// A picture out of half blocks: each character is two pixels, one above the other.
fn in_blocks(rgb: &[u8], width_px: u32, height_px: u32) -> String {
    let columns = width_px.clamp(1, MAX_COLUMNS);
    let rows = (height_px * columns / width_px.max(1)).max(1);
    let pixel = |column: u32, row: u32| {
        let (x, y) = (column * width_px / columns, (row * height_px / rows).min(height_px.saturating_sub(1)));
        let at = ((y * width_px + x) * 3) as usize;
        rgb.get(at..at + 3).map_or([0; 3], |p| [p[0], p[1], p[2]])
    };
    let mut text = String::new();
    for row in (0..rows).step_by(2) {
        for column in 0..columns {
            let ([r, g, b], [br, bg, bb]) = (pixel(column, row), pixel(column, row + 1));
            let _ = write!(text, "\x1b[38;2;{r};{g};{b}m\x1b[48;2;{br};{bg};{bb}m\u{2580}");
        }
        text += "\x1b[0m\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A picture of two rows is one line of blocks, the upper pixel before the lower.
    #[test]
    fn two_pixels_make_a_block() {
        let text = in_blocks(&[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12], 2, 2);
        assert_eq!(text.lines().count(), 1);
        assert!(text.starts_with("\x1b[38;2;1;2;3m\x1b[48;2;7;8;9m\u{2580}"), "{text:?}");
        assert_eq!(in_blocks(&vec![0; 200 * 100 * 3], 200, 100).lines().count(), 20);
    }
}
