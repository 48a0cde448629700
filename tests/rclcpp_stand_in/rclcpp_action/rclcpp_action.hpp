// What examples/cpp uses of rclcpp_action: there is never a server. See rclcpp/rclcpp.hpp here.
#pragma once

#include <chrono>
#include <future>
#include <memory>
#include <string>

#include "action_msgs/srv/cancel_goal.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rosidl_typesupport_cpp/action_type_support.hpp"

namespace rclcpp_action
{
template<typename Action>
struct ClientGoalHandle
{
  struct WrappedResult { typename Action::Result::SharedPtr result; };
};
template<typename Action>
struct Client
{
  using GoalHandle = ClientGoalHandle<Action>;
  bool wait_for_action_server(std::chrono::seconds) {return false;}
  std::shared_future<std::shared_ptr<GoalHandle>> async_send_goal(const typename Action::Goal &) {return {};}
  std::shared_future<std::shared_ptr<action_msgs::srv::CancelGoal::Response>> async_cancel_goal(
    std::shared_ptr<GoalHandle>) {return {};}
  std::shared_future<typename GoalHandle::WrappedResult> async_get_result(std::shared_ptr<GoalHandle>) {return {};}
};
template<typename Action>
std::shared_ptr<Client<Action>> create_client(std::shared_ptr<rclcpp::Node>, const std::string &)
{
  // Defined in the libraries of the action's package, which the real one needs to be linked too.
  rosidl_typesupport_cpp::get_action_type_support_handle<Action>();
  return std::make_shared<Client<Action>>();
}
}  // namespace rclcpp_action
