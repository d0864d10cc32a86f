//! `carff probe image`: writes images to files, or shows them in the terminal.

use super::file_in;
use super::inline::{Inline, columns};
use crate::complete;
use crate::session::{Session, SessionArgs, colours};
use anyhow::{Context, bail, ensure};
use carff_messages::forms::AnyMessage;
use carff_messages::{FrameMeta, ImageMeta, ViewKind, ViewMeta};
use carff_transport::TopicId;
use clap::Args;
use clap_complete::engine::ArgValueCandidates;
use std::io::Write as _;
use std::path::PathBuf;

/// Show images.
#[derive(Clone, Debug, Args)]
pub struct ImageArgs {
    /// Topic: `camera/frame`, `renderer/view`, or images of the same types from another stage.
    #[arg(add = ArgValueCandidates::new(complete::topics))]
    pub topic: String,
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
        args.out.is_some() || args.inline != Inline::Auto || colours(),
        "the output is not a terminal with colours: name a folder for PNG files with -o, or a protocol with --as"
    );
    let inline = if args.out.is_some() { args.inline } else { args.inline.resolved() };
    let columns = columns();
    let mut session = Session::open(&args.session, "probe-image")?;
    let topic = session.topic(&args.topic)?;
    let (message, _) = topic.schema();
    ensure!(
        [TopicId::FRAME, TopicId::VIEW].iter().any(|known| known.schema().0 == message),
        "topic `{topic}` has no images that this program knows: use `{}` or `{}`",
        TopicId::FRAME,
        TopicId::VIEW
    );
    session.listen([topic])?;
    let mut shown = 0;
    let going = session.follow(
        |_, message| {
            let message = message.message();
            let Some((name, [width_px, height_px])) = named_image(message) else {
                bail!("the message is not an image")
            };
            let rgb = message.bytes();
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

/// The file name, without an ending, and the size of a camera frame or a rendered view.
pub(crate) fn named_image(message: AnyMessage<'_>) -> Option<(String, [u32; 2])> {
    if let Some(frame) = message.get::<FrameMeta>() {
        return Some((format!("frame-{:06}", frame.header.frame_id), frame.size_px()));
    }
    let view = message.get::<ViewMeta>()?;
    let kind = ViewKind::try_from(view.kind).map_or("view", ViewKind::name);
    let ViewMeta { header, hypothesis, .. } = view;
    let name = format!("view-{:06}-step{}-{hypothesis:02}-{kind}", header.frame_id, header.step);
    Some((name, view.size_px()))
}
