// What examples/cpp uses of rclcpp, declared only: the ROS 2 wheels have none. Enough to check the example's messages.
#pragma once

#include <chrono>
#include <cstdio>
#include <future>
#include <memory>
#include <string>

#define RCLCPP_INFO(logger, ...) ((void)(logger), std::printf(__VA_ARGS__))
#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::printf(__VA_ARGS__))

namespace rclcpp
{
enum class FutureReturnCode { SUCCESS, INTERRUPTED, TIMEOUT };
struct Logger {};
struct Node
{
  explicit Node(const std::string & name);
  Logger get_logger() const;
};
void init(int argc, char const * const * argv);
bool shutdown();
template<typename Future>
FutureReturnCode spin_until_future_complete(
  std::shared_ptr<Node> node, const Future & future, std::chrono::seconds timeout);
}  // namespace rclcpp
