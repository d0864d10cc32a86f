//! Sources of the camera's images, without topics.

mod drive_source;
mod folder_source;
mod free_source;
mod mcap_source;
pub mod recorded;
pub mod source;
mod video_source;

pub use drive_source::DriveSource;
pub use folder_source::FolderSource;
pub use free_source::FreeDriveSource;
pub use mcap_source::McapSource;
pub use source::Source;
pub use video_source::VideoSource;
