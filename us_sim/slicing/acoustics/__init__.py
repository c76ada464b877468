"""What the sound meets on its way: loss, shadows, surfaces and fibres along the current beams."""
