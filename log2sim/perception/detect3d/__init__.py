"""3D detection of road users in clouds: networks on a bird's-eye-view grid, or the boxes that a log brings."""
