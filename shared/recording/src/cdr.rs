//! Reads messages of ROS 2 in CDR, borrowing texts and bytes.

use crate::MessageError;

/// A position in a message.
pub(crate) struct Cdr<'a> {
    data: &'a [u8],
    at: usize,
    is_big: bool,
    /// Largest alignment: 8, and 4 in version 2.
    most: usize,
}

impl<'a> Cdr<'a> {
    /// Reads the header of a message: its byte order and version.
    pub(crate) fn new(message: &'a [u8]) -> Result<Self, MessageError> {
        let (head, data) = message.split_first_chunk::<4>().ok_or_else(cut_off)?;
        match head[1] {
            kind @ (0 | 1) if head[0] == 0 => Ok(Self { data, at: 0, is_big: kind == 0, most: 8 }),
            kind @ (6 | 7) if head[0] == 0 => Ok(Self { data, at: 0, is_big: kind == 6, most: 4 }),
            kind => Err(MessageError(format!("its CDR representation {kind} is not supported"))),
        }
    }

    fn take(&mut self, bytes: usize, alignment: usize) -> Result<&'a [u8], MessageError> {
        let start = self.at.next_multiple_of(alignment.min(self.most));
        let end = start.checked_add(bytes).ok_or_else(cut_off)?;
        let taken = self.data.get(start..end).ok_or_else(cut_off)?;
        self.at = end;
        Ok(taken)
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], MessageError> {
        let mut bytes: [u8; N] = self.take(N, N)?.try_into().map_err(|_| cut_off())?;
        if self.is_big {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub(crate) fn u8(&mut self) -> Result<u8, MessageError> {
        Ok(self.number::<1>()?[0])
    }

    pub(crate) fn u32(&mut self) -> Result<u32, MessageError> {
        Ok(u32::from_le_bytes(self.number()?))
    }

    pub(crate) fn f64(&mut self) -> Result<f64, MessageError> {
        Ok(f64::from_le_bytes(self.number()?))
    }

    /// Returns a sequence of bytes.
    pub(crate) fn bytes(&mut self) -> Result<&'a [u8], MessageError> {
        let length = self.u32()? as usize;
        self.take(length, 1)
    }

    /// Returns a text, which ends with a zero.
    pub(crate) fn text(&mut self) -> Result<&'a str, MessageError> {
        let bytes = self.bytes()?;
        let text = std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes));
        text.map_err(|_| MessageError("a text is not UTF-8".to_owned()))
    }

    /// Returns `count` numbers.
    pub(crate) fn f64s(&mut self, count: usize) -> Result<Vec<f64>, MessageError> {
        // A wrong count ends at the end of the message, before it reserves memory.
        (0..count).map(|_| self.f64()).collect()
    }

    /// Returns the time, nanoseconds since 1970, and the coordinate frame with which messages of sensors begin.
    pub(crate) fn header(&mut self) -> Result<(u64, &'a str), MessageError> {
        let (seconds, nanoseconds) = (self.u32()?, self.u32()?);
        Ok((u64::from(seconds) * 1_000_000_000 + u64::from(nanoseconds), self.text()?))
    }
}

fn cut_off() -> MessageError {
    MessageError("the message is cut off".to_owned())
}
