//! `carff probe image`: writes images to files, or shows them in the terminal.

use super::file_in;
use super::inline::{Inline, columns};
use super::session::{Session, SessionArgs, colours};
use anyhow::{Context, bail, ensure};
use carff_messages::{ViewKind, ViewMeta};
use carff_observe::{Received, TopicId};
use clap::Args;
use std::io::Write as _;
use std::path::PathBuf;

/// Show images.
#[derive(Clone, Debug, Args)]
pub struct ImageArgs {
    /// Topic: `camera/frame` or `renderer/view`.
    pub topic: TopicId,
    /// Folder for PNG files; without it images are shown in the terminal.
    #[arg(short, long)]
    pub out: Option<PathBuf>,
    /// Protocol for images in the terminal.
    #[arg(long = "as", value_name = "WAY", value_enum, default_value_t, conflicts_with = "out")]
    pub inline: Inline,
    /// Stop after this number of images.
    #[arg(long)]
    pub count: Option<u64>,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

pub(super) fn run(args: &ImageArgs) -> anyhow::Result<()> {
    ensure!(
        matches!(args.topic, TopicId::Frame | TopicId::View),
        "topic `{}` has no images: use `{}` or `{}`",
        args.topic,
        TopicId::Frame,
        TopicId::View
    );
    ensure!(
        args.out.is_some() || args.inline != Inline::Auto || colours(),
        "the output is not a terminal with colours: name a folder for PNG files with -o, or a protocol with --as"
    );
    let inline = if args.out.is_some() { args.inline } else { args.inline.resolved() };
    let columns = columns();
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
                _ => bail!("no image"),
            };
            if let Some(folder) = &args.out {
                let path = file_in(folder, &format!("{name}.png"))?;
                image::save_buffer(&path, rgb, width_px, height_px, image::ColorType::Rgb8)
                    .with_context(|| format!("cannot write {}", path.display()))?;
                println!("{}", path.display());
            } else {
                println!("{}{name}", inline.encode(rgb, [width_px, height_px], columns)?);
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

/// Returns a rendered view's file name: frame, step, hypothesis, camera.
pub(crate) fn view_name(meta: &ViewMeta) -> String {
    let kind = ViewKind::try_from(meta.kind).map_or("view", ViewKind::name);
    format!("view-{:06}-step{}-{:02}-{kind}", meta.header.frame_id, meta.header.step, meta.hypothesis)
}
