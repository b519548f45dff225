"""What the torch backend is made of: views and storage on a device, and the work there in plain torch or in Triton."""
