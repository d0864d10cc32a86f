//! Errors as sentences.

use std::error::Error;

/// Returns an error and its causes as one sentence. A cause that the sentence already contains is left out.
///
/// ```
/// let cause = std::io::Error::other("disk on fire");
/// assert_eq!(carff_base::errors::sentence(&cause), "disk on fire");
/// ```
pub fn sentence(error: &(dyn Error + 'static)) -> String {
    let mut sentence = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        let cause = error.to_string();
        if !sentence.contains(&cause) {
            sentence = format!("{sentence}: {cause}");
        }
        source = error.source();
    }
    sentence
}
