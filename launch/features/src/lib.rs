//! Features of libraries that a build of a part of the workspace has in common with a build of the whole; no code.
