# For find_package: see rclcpp.hpp here. The targets of the wheels name libraries that a wheel does not have.
find_library(rmw_library rmw_fastrtps_cpp REQUIRED)
set(rclcpp_INCLUDE_DIRS "${CMAKE_CURRENT_LIST_DIR}/..")
set(rclcpp_LIBRARIES "${rmw_library}")
