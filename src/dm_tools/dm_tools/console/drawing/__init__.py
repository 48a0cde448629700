"""Pictures of the console as SVG text, made on the server: they need nothing from the internet."""
