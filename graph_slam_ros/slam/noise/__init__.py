"""The scale of noise: estimated from residuals, and used for what comes."""
