"""AgileX Hunter 2.0 and Hunter SE over CAN."""
