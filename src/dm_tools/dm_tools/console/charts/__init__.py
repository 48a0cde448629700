"""Charts of the console as options of Apache ECharts, which NiceGUI serves itself: nothing comes from the internet."""
