//! The interface of all image sources.

use carff_messages::FrameMeta;

/// A source of images.
pub trait Source {
    /// Returns the number of bytes of its largest image.
    fn max_image_bytes(&self) -> usize;

    /// Advances to the next frame and returns its description without the header; `None` at the end. An error ends the
    /// stage.
    fn advance(&mut self) -> anyhow::Result<Option<FrameMeta>>;

    /// Writes the current frame's image (RGB, 8 bit) once, into memory of exactly its size: the topic's shared memory.
    /// `frame_id` names the noise.
    fn write(&mut self, frame_id: u64, image: &mut [u8]) -> anyhow::Result<()>;
}
