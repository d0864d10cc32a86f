//! Activations in blocks of 16 samples: the layout that all kernels read and write.
//!
//! A block holds `rows` rows (one for each feature or neuron) of 16 numbers (one for each sample), so that a kernel
//! reads it front to back. Blocks are [`stride`] numbers apart: one row of padding keeps equal rows of neighbouring
//! blocks out of the same cache set.

use std::ops::Range;

/// Samples of one block.
pub(crate) const LANES: usize = 16;

/// Numbers from the start of one block of `rows` rows to the start of the next.
pub(crate) const fn stride(rows: usize) -> usize {
    rows * LANES + LANES
}

/// Index of one sample's number in one row.
#[inline(always)]
const fn index(rows: usize, sample: usize, row: usize) -> usize {
    sample / LANES * stride(rows) + row * LANES + sample % LANES
}

/// A view of blocks with equal numbers of rows.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Blocks<'a> {
    data: &'a [f32],
    rows: usize,
}

/// A view of blocks with equal numbers of rows, to write to.
#[derive(Debug)]
pub(crate) struct BlocksMut<'a> {
    data: &'a mut [f32],
    rows: usize,
}

impl<'a> Blocks<'a> {
    /// A view of whole blocks of `rows` rows.
    #[cfg(test)]
    pub fn new(data: &'a [f32], rows: usize) -> Self {
        Self { data, rows }
    }

    /// Numbers from one block to the next.
    #[inline(always)]
    pub fn stride(self) -> usize {
        stride(self.rows)
    }

    /// Number of blocks.
    #[inline(always)]
    pub fn count(self) -> usize {
        self.data.len() / self.stride()
    }

    /// All numbers, padding included.
    #[inline(always)]
    pub fn as_slice(self) -> &'a [f32] {
        self.data
    }

    /// One sample's number in one row.
    #[inline(always)]
    pub fn at(self, sample: usize, row: usize) -> f32 {
        self.data[index(self.rows, sample, row)]
    }

    /// One sample's first three rows: its colour, where blocks are a colour network's output.
    #[inline(always)]
    pub fn rgb(self, sample: usize) -> [f32; 3] {
        [0, 1, 2].map(|c| self.at(sample, c))
    }

    /// A part of the blocks.
    #[inline(always)]
    pub fn range(self, blocks: Range<usize>) -> Self {
        let stride = self.stride();
        Self { data: &self.data[blocks.start * stride..blocks.end * stride], ..self }
    }

    /// The blocks one after the other, padding included.
    #[inline(always)]
    pub fn iter(self) -> std::slice::ChunksExact<'a, f32> {
        self.data.chunks_exact(self.stride())
    }
}

impl<'a> BlocksMut<'a> {
    /// A view of whole blocks of `rows` rows.
    #[cfg(test)]
    pub fn new(data: &'a mut [f32], rows: usize) -> Self {
        Self { data, rows }
    }

    /// The same view for a shorter time.
    #[inline(always)]
    pub fn reborrow(&mut self) -> BlocksMut<'_> {
        BlocksMut { data: self.data, rows: self.rows }
    }

    /// A view to read from.
    #[inline(always)]
    fn as_blocks(&self) -> Blocks<'_> {
        Blocks { data: self.data, rows: self.rows }
    }

    /// This view to read from, for as long as it is valid.
    #[inline(always)]
    pub fn into_blocks(self) -> Blocks<'a> {
        Blocks { data: self.data, rows: self.rows }
    }

    /// Numbers from one block to the next.
    #[inline(always)]
    pub fn stride(&self) -> usize {
        stride(self.rows)
    }

    /// Number of blocks.
    #[inline(always)]
    pub fn count(&self) -> usize {
        self.as_blocks().count()
    }

    /// All numbers, padding included.
    #[inline(always)]
    pub fn as_mut_slice(&mut self) -> &mut [f32] {
        self.data
    }

    /// All numbers, padding included, for as long as the view is valid.
    #[inline(always)]
    pub fn into_mut_slice(self) -> &'a mut [f32] {
        self.data
    }

    /// One sample's number in one row.
    #[inline(always)]
    pub fn at_mut(&mut self, sample: usize, row: usize) -> &mut f32 {
        &mut self.data[index(self.rows, sample, row)]
    }

    /// A part of the blocks.
    #[inline(always)]
    pub fn range(self, blocks: Range<usize>) -> Self {
        let stride = stride(self.rows);
        Self { data: &mut self.data[blocks.start * stride..blocks.end * stride], ..self }
    }

    /// The blocks one after the other, padding included.
    #[inline(always)]
    pub fn iter_mut(&mut self) -> std::slice::ChunksExactMut<'_, f32> {
        self.data.chunks_exact_mut(stride(self.rows))
    }

    /// Views of up to `blocks` blocks at a time.
    pub fn groups(self, blocks: usize) -> impl Iterator<Item = BlocksMut<'a>> {
        let rows = self.rows;
        self.data.chunks_mut(blocks * stride(rows)).map(move |data| BlocksMut { data, rows })
    }

    /// Copies the first `rows` rows of a sample of other blocks to a sample here.
    #[inline(always)]
    pub fn copy_sample(&mut self, sample: usize, from: Blocks<'_>, from_sample: usize, rows: usize) {
        let from = &from.data[index(from.rows, from_sample, 0)..];
        let to = &mut self.data[index(self.rows, sample, 0)..];
        for r in 0..rows {
            to[r * LANES] = from[r * LANES];
        }
    }

    /// Writes one sample's numbers to consecutive rows.
    #[inline(always)]
    pub fn write_sample(&mut self, sample: usize, first_row: usize, values: &[f32]) {
        let to = &mut self.data[index(self.rows, sample, first_row)..];
        for (r, v) in values.iter().enumerate() {
            to[r * LANES] = *v;
        }
    }
}

/// A buffer for blocks that keeps its contents and its memory from use to use.
#[derive(Clone, Debug, Default)]
pub(crate) struct BlockBuffer(Vec<f32>);

impl BlockBuffer {
    /// The first `count` blocks of `rows` rows, which the last use may have filled; room is made when it is missing.
    #[inline]
    pub fn blocks_mut(&mut self, rows: usize, count: usize) -> BlocksMut<'_> {
        let len = stride(rows) * count;
        if self.0.len() < len {
            self.0.resize(len, 0.0);
        }
        BlocksMut { data: &mut self.0[..len], rows }
    }

    /// The first `count` blocks of `rows` rows, as [`Self::blocks_mut`] was filled.
    #[inline]
    pub fn blocks(&self, rows: usize, count: usize) -> Blocks<'_> {
        Blocks { data: &self.0[..stride(rows) * count], rows }
    }
}
