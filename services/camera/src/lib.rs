//! Sources of the camera's images, without topics.

mod drive_source;
mod folder_source;
mod free_source;
pub mod source;

pub use drive_source::DriveSource;
pub use folder_source::FolderSource;
pub use free_source::FreeDriveSource;
pub use source::Source;
