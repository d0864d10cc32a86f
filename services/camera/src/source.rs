//! The interface of all image sources.

use carff_messages::FrameMeta;

/// A source of images.
pub trait Source {
    /// Bytes of its largest image.
    fn max_picture_bytes(&self) -> usize;

    /// Advances to the next frame and describes it (all but the header); `None` at the end. An error ends the stage.
    fn advance(&mut self) -> anyhow::Result<Option<FrameMeta>>;

    /// Writes the current frame's image, RGB, 8 bit, once, into memory of exactly its size: that of the topic.
    /// `frame_id` names the noise.
    fn write(&mut self, frame_id: u64, picture: &mut [u8]) -> anyhow::Result<()>;
}
