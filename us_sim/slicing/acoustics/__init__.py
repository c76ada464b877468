"""Sound along the current beams: loss, shadows, surfaces and fibres."""
