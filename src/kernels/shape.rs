//! The shape of a convolution: sizes of its images, kernel, stride and padding.

/// Shape of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ConvolutionShape {
    /// Images.
    pub batch: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Rows and columns of the input.
    pub size: [usize; 2],
    /// Rows and columns of the kernel.
    pub kernel: [usize; 2],
    /// Step between two outputs, rows and columns.
    pub stride: [usize; 2],
    /// Zeros added on each side, rows and columns.
    pub padding: [usize; 2],
}

impl ConvolutionShape {
    /// Rows and columns of the output.
    pub fn output_size(&self) -> [usize; 2] {
        [0, 1].map(|axis| (self.size[axis] + 2 * self.padding[axis] - self.kernel[axis]) / self.stride[axis] + 1)
    }

    pub(super) fn taps(&self) -> usize {
        self.kernel[0] * self.kernel[1]
    }

    pub(super) fn input_plane(&self) -> usize {
        self.size[0] * self.size[1]
    }

    pub(super) fn output_plane(&self) -> usize {
        let [rows, columns] = self.output_size();
        rows * columns
    }

    /// Values of an input.
    pub fn input_len(&self) -> usize {
        self.batch * self.inputs * self.input_plane()
    }

    /// Values of an output.
    pub fn output_len(&self) -> usize {
        self.batch * self.outputs * self.output_plane()
    }

    /// Values of the weights.
    pub fn weight_len(&self) -> usize {
        self.outputs * self.inputs * self.taps()
    }

    pub(super) fn check(&self, input: Option<&[f32]>, weight: Option<&[f32]>, output: Option<&[f32]>) {
        let sizes = [self.batch, self.inputs, self.outputs].into_iter().chain(self.size).chain(self.kernel);
        assert!(sizes.chain(self.stride).all(|size| size > 0), "convolution: nothing to do ({self:?})");
        assert!(
            (0..2).all(|axis| self.kernel[axis] <= self.size[axis] + 2 * self.padding[axis]),
            "convolution: the kernel must fit the padded image ({self:?})"
        );
        assert!(input.is_none_or(|values| values.len() == self.input_len()), "convolution: input and {self:?}");
        assert!(weight.is_none_or(|values| values.len() == self.weight_len()), "convolution: weight and {self:?}");
        assert!(output.is_none_or(|values| values.len() == self.output_len()), "convolution: output and {self:?}");
    }
}
