# For find_package: see rclcpp_action.hpp here.
set(rclcpp_action_INCLUDE_DIRS "${CMAKE_CURRENT_LIST_DIR}/..")
