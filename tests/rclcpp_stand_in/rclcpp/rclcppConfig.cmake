# For find_package: see rclcpp.hpp here.
set(rclcpp_INCLUDE_DIRS "${CMAKE_CURRENT_LIST_DIR}/..")
