"""What commands share: options, output, progress, and the shell around them."""
