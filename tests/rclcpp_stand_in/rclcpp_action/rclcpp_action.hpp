// What examples/cpp uses of rclcpp_action, declared only, see rclcpp/rclcpp.hpp here.
#pragma once

#include <chrono>
#include <future>
#include <memory>
#include <string>

#include "action_msgs/srv/cancel_goal.hpp"
#include "rclcpp/rclcpp.hpp"

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
  bool wait_for_action_server(std::chrono::seconds timeout);
  std::shared_future<std::shared_ptr<GoalHandle>> async_send_goal(const typename Action::Goal & goal);
  std::shared_future<std::shared_ptr<action_msgs::srv::CancelGoal::Response>> async_cancel_goal(
    std::shared_ptr<GoalHandle> handle);
  std::shared_future<typename GoalHandle::WrappedResult> async_get_result(std::shared_ptr<GoalHandle> handle);
};
template<typename Action>
std::shared_ptr<Client<Action>> create_client(std::shared_ptr<rclcpp::Node> node, const std::string & name);
}  // namespace rclcpp_action
