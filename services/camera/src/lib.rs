//! Sources of the camera's images, without topics.

mod drive_source;
mod folder_source;
mod free_source;
#[cfg(feature = "recordings")]
mod mcap_source;
pub mod recorded;
pub mod source;
#[cfg(feature = "video")]
mod video_source;

pub use drive_source::DriveSource;
pub use folder_source::FolderSource;
pub use free_source::FreeDriveSource;
#[cfg(feature = "recordings")]
pub use mcap_source::McapSource;
pub use source::Source;
#[cfg(feature = "video")]
pub use video_source::VideoSource;
