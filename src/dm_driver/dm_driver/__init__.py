"""Drive electronics, safety limiter and node for piezo deformable mirrors."""
