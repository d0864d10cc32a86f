//! Messages with overwritten bytes, as a rogue writer to shared memory can publish.

/// Applies patches to `$message` (a variable of one of the message structs). A patch is an offset (two bytes, little
/// endian), a length (one byte) and its bytes. Bytes outside the message are ignored.
macro_rules! patch {
    ($message:ident, $bytes:expr) => {{
        let mut rest: &[u8] = $bytes;
        while let [low, high, length, tail @ ..] = rest {
            let offset = usize::from(u16::from_le_bytes([*low, *high])) % size_of_val(&$message);
            let room = size_of_val(&$message) - offset;
            let patch = &tail[..usize::from(*length).min(tail.len())];
            // SAFETY: `offset` and the count are within the message, which the patch does not overlap; messages are
            // structs of plain numbers, for which any bytes are a value (they are `ZeroCopySend` for the same reason).
            unsafe {
                std::ptr::copy_nonoverlapping(
                    patch.as_ptr(),
                    (&raw mut $message).cast::<u8>().add(offset),
                    patch.len().min(room),
                );
            }
            rest = &tail[patch.len()..];
        }
    }};
}

pub(crate) use patch;
