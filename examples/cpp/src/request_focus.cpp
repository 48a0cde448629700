// Ask the mirror for a curvature and wait until its shape stands: ros2 run dm_example_cpp request_focus 0.02

#include <chrono>
#include <cstdlib>
#include <memory>

#include "dm_msgs/action/move_focus.hpp"
#include "dm_msgs/msg/error_code.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_action/rclcpp_action.hpp"

using dm_msgs::action::MoveFocus;
using dm_msgs::msg::ErrorCode;

int main(int argc, char ** argv)
{
  const auto arguments = rclcpp::init_and_remove_ros_arguments(argc, argv);  // --ros-args and what follows is not ours
  auto node = std::make_shared<rclcpp::Node>("request_focus");
  auto client = rclcpp_action::create_client<MoveFocus>(node, "move_focus");

  MoveFocus::Goal goal;
  goal.tolerance = 20e-9;  // m, largest predicted Zernike coefficient error that will do
  goal.request.curvature = 0.02;  // 1/m of the surface, positive = concave
  if (arguments.size() > 1) {
    char * end = nullptr;
    goal.request.curvature = std::strtod(arguments[1].c_str(), &end);
    if (end == arguments[1].c_str() || *end != '\0') {
      RCLCPP_ERROR(node->get_logger(), "curvature %s: must be a number, 1/m", arguments[1].c_str());
      return EXIT_FAILURE;
    }
  }
  if (!client->wait_for_action_server(std::chrono::seconds(10))) {
    RCLCPP_ERROR(node->get_logger(), "no action move_focus: is focus_controller running?");
    return EXIT_FAILURE;
  }

  auto accepted = client->async_send_goal(goal);
  if (rclcpp::spin_until_future_complete(node, accepted, std::chrono::seconds(5)) != rclcpp::FutureReturnCode::SUCCESS ||
    !accepted.get())
  {
    RCLCPP_ERROR(node->get_logger(), "the goal was not accepted");
    return EXIT_FAILURE;
  }
  auto ended = client->async_get_result(accepted.get());
  if (rclcpp::spin_until_future_complete(node, ended, std::chrono::seconds(60)) != rclcpp::FutureReturnCode::SUCCESS) {
    RCLCPP_ERROR(node->get_logger(), "the move did not end within 60 s: it is cancelled");
    rclcpp::spin_until_future_complete(node, client->async_cancel_goal(accepted.get()), std::chrono::seconds(5));
    return EXIT_FAILURE;
  }
  const auto result = ended.get().result;
  if (result->error_code != ErrorCode::OK) {  // every refusal has a code and a sentence
    RCLCPP_ERROR(node->get_logger(), "refused with %d: %s", result->error_code, result->message.c_str());
    return EXIT_FAILURE;
  }
  RCLCPP_INFO(
    node->get_logger(), "%+.4f 1/m stands after %.2f s; largest coefficient error below %.1f nm (95 %%)",
    result->state.curvature, result->duration, 1e9 * result->state.predicted_max_zernike_upper);
  rclcpp::shutdown();
  return EXIT_SUCCESS;
}
