//! Memory that many threads fill, each its own part.

use std::marker::PhantomData;

/// Builds a vector of `len` values from parts written by several threads, without filling it first.
///
/// # Safety
/// `fill` must write every one of the `len` values.
pub(super) unsafe fn filled(len: usize, fill: impl FnOnce(Shared<'_>)) -> Vec<f32> {
    let mut values = Vec::with_capacity(len);
    fill(Shared { start: values.as_mut_ptr(), len, lifetime: PhantomData });
    // SAFETY: the capacity is `len`, and the caller promises that all values were written.
    unsafe { values.set_len(len) };
    values
}

/// A buffer that threads share, each writing places no other thread touches.
#[derive(Clone, Copy)]
pub(super) struct Shared<'a> {
    start: *mut f32,
    len: usize,
    lifetime: PhantomData<&'a mut [f32]>,
}

// SAFETY: all access goes through `part` and `write`, whose callers promise disjoint places.
unsafe impl Send for Shared<'_> {}
// SAFETY: as for `Send`.
unsafe impl Sync for Shared<'_> {}

impl Shared<'_> {
    /// A stretch of the buffer, to write.
    ///
    /// # Safety
    /// No other part that overlaps it is alive on any thread, and its values are written before they
    /// are read.
    #[inline(always)]
    #[allow(clippy::mut_from_ref, reason = "that is what sharing by disjoint parts means")]
    pub unsafe fn part(&self, start: usize, len: usize) -> &mut [f32] {
        debug_assert!(start + len <= self.len);
        // SAFETY: the stretch lies inside the allocation, and the caller promises that nobody else has it.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(start), len) }
    }

    /// Writes one value.
    ///
    /// # Safety
    /// `index` lies in the buffer, and no other thread touches it.
    #[inline(always)]
    pub unsafe fn write(&self, index: usize, value: f32) {
        debug_assert!(index < self.len);
        // SAFETY: promised by the caller.
        unsafe { self.start.add(index).write(value) };
    }
}
