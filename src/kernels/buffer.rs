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

/// A buffer that threads share, each writing places no other thread touches. Writes outside it panic.
#[derive(Clone, Copy)]
pub(super) struct Shared<'a> {
    start: *mut f32,
    len: usize,
    lifetime: PhantomData<&'a mut [f32]>,
}

// SAFETY: all access goes through the methods below, whose callers promise disjoint places.
unsafe impl Send for Shared<'_> {}
// SAFETY: as for `Send`.
unsafe impl Sync for Shared<'_> {}

impl Shared<'_> {
    /// A stretch of the buffer, set to zero.
    ///
    /// # Safety
    /// Nobody else touches the stretch while this part of it is in use.
    #[inline(always)]
    #[allow(clippy::mut_from_ref, reason = "that is what sharing by disjoint parts means")]
    pub unsafe fn zeroed(&self, start: usize, len: usize) -> &mut [f32] {
        let stretch = self.stretch(start, len);
        // SAFETY: `stretch` checked that the places lie in the allocation; zero bytes are the float 0, so
        // the slice is initialised; the caller promises that nobody else has it.
        unsafe {
            stretch.write_bytes(0, len);
            std::slice::from_raw_parts_mut(stretch, len)
        }
    }

    /// Writes values plus a constant from `start` on, and hands out what was written.
    ///
    /// # Safety
    /// Nobody else touches these places while they are in use.
    #[inline(always)]
    #[allow(clippy::mut_from_ref, reason = "that is what sharing by disjoint parts means")]
    pub unsafe fn written_sum(&self, start: usize, values: &[f32], constant: f32) -> &mut [f32] {
        let stretch = self.stretch(start, values.len());
        for (index, value) in values.iter().enumerate() {
            // SAFETY: `stretch` checked as many places as there are values; the caller has them alone.
            unsafe { stretch.add(index).write(value + constant) };
        }
        // SAFETY: just written, and the caller's alone.
        unsafe { std::slice::from_raw_parts_mut(stretch, values.len()) }
    }

    /// Writes values `step` apart, from `start` on.
    ///
    /// # Safety
    /// Nobody else touches these places.
    #[inline(always)]
    pub unsafe fn write_every(&self, step: usize, start: usize, values: &[f32]) {
        let Some(last) = values.len().checked_sub(1) else { return };
        let stretch = self.stretch(start, last * step + 1);
        for (index, &value) in values.iter().enumerate() {
            // SAFETY: `stretch` checked the last of these places; the caller has them alone.
            unsafe { stretch.add(index * step).write(value) };
        }
    }

    /// Writes each value to its place in the stretch of `len` values from `start` on.
    ///
    /// # Safety
    /// Nobody else touches these places.
    #[inline(always)]
    pub unsafe fn scatter(&self, start: usize, len: usize, places: &[usize], values: &[f32]) {
        let stretch = self.stretch(start, len);
        for (&place, &value) in places.iter().zip(values) {
            assert!(place < len, "a place outside the stretch");
            // SAFETY: asserted; the caller has the place alone.
            unsafe { stretch.add(place).write(value) };
        }
    }

    #[inline(always)]
    fn stretch(&self, start: usize, len: usize) -> *mut f32 {
        assert!(start <= self.len && len <= self.len - start, "a part outside the buffer");
        // SAFETY: asserted above.
        unsafe { self.start.add(start) }
    }
}
